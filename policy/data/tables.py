"""Read JSON and columns of Arrow tables; what is wrong is raised as a ``DatasetError``."""

import hashlib
from pathlib import Path
from typing import Any, cast, get_args

import numpy as np
import pyarrow as pa

from policy import files
from policy.contract import FloatArray, StateFrame
from policy.data.flight_data import DatasetError, Nanoseconds


def read_json(path: Path, kind: str) -> Any:
    """The contents of a JSON file; ``kind`` names what its folder should be."""
    try:
        return files.read_json(path)
    except OSError as error:
        raise DatasetError(f"{path}: {error.strerror}: is it a {kind}?") from error
    except ValueError as error:
        raise DatasetError(f"{path} is not JSON: {error}") from error


def parse_state_frame(name: str, value: object) -> StateFrame:
    """A state frame by its name in a file."""
    if value not in get_args(StateFrame):
        raise DatasetError(
            f"{name}: its state frame is {value!r}; known are {list(get_args(StateFrame))}"
        )
    return cast(StateFrame, value)


def stamps(name: str, table: pa.Table, column: str) -> Nanoseconds:
    """A column of integers, none of them missing."""
    return numbers(name, table, column).astype(np.int64)


def numbers(name: str, table: pa.Table, column: str) -> np.ndarray:
    """A column of numbers of its own type, none of them missing."""
    values = table[column]
    if values.null_count:
        raise DatasetError(f"{name}: {column} is missing in {values.null_count} rows")
    array = np.asarray(values.to_numpy())
    if array.ndim != 1 or array.dtype.kind not in "if":
        raise DatasetError(f"{name}: {column} must hold a number a row")
    return array


def vectors(name: str, table: pa.Table, column: str, width: int) -> FloatArray:
    """A column of lists of ``width`` finite numbers as [rows, width] float32, NaN where null."""
    values = table[column].combine_chunks()
    valid = values.is_valid().to_numpy(zero_copy_only=False).astype(bool)
    try:
        flat = values.drop_null().flatten().to_numpy(zero_copy_only=False).astype(np.float32)
    except (AttributeError, TypeError, ValueError):
        flat = None
    if flat is None or flat.size != valid.sum() * width:
        raise DatasetError(f"{name}: {column} must hold {width} numbers a row")
    rows = flat.reshape(-1, width)
    if (bad := np.flatnonzero(~np.isfinite(rows).all(axis=1))).size:
        row = int(np.flatnonzero(valid)[bad[0]])
        raise DatasetError(f"{name}: {column} holds NaN or infinity in row {row}")
    out = np.full((table.num_rows, width), np.nan, dtype=np.float32)
    out[valid] = rows
    return out


def file_digest(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
