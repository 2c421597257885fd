"""Reading of JSON and Arrow columns; faults are raised as ``DatasetError``."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from numpy.typing import NDArray

from policy.contract import FloatArray
from policy.data.flight_data import DatasetError, Nanoseconds
from policy.files import why_unreadable

MAX_ROWS = 10_000_000
"""More than a day at 100 Hz. A small file can claim many more rows and fill the memory."""

_LABELS = (
    *("expert", "position_ned_m", "ned_from_body_wxyz", "velocity_ned_mps", "next_gate"),
    *("gate_body_m", "gate_yaw_rad", "gate_after_body_m"),
)
"""Columns that only demonstrations have."""


def stamps(name: str, table: pa.Table, column: str) -> Nanoseconds:
    """Return a column of integers without nulls."""
    return number_column(name, retyped(name, table, column, pa.int64()), column).copy()


def retyped(name: str, table: pa.Table, column: str, kind: pa.DataType) -> pa.Table:
    """Return the table with a column of this type; raise DatasetError if a value does not fit."""
    try:
        values = table[column].cast(kind)
    except pa.ArrowException as error:
        kinds = f"{kind}, not {table[column].type}"
        raise DatasetError(f"{name}: {column} must hold {kinds} ({error})") from error
    return table.set_column(table.column_names.index(column), column, values)


def number_column(name: str, table: pa.Table, column: str) -> np.ndarray:
    """Return a column of numbers, in its own type, without nulls."""
    values = table[column]
    if values.null_count:
        raise DatasetError(f"{name}: {column} is missing in {values.null_count} rows")
    array = np.asarray(values.to_numpy())
    if array.size and (array.ndim != 1 or array.dtype.kind not in "if"):
        raise DatasetError(f"{name}: {column} must hold a number a row")
    return array


def vectors(name: str, table: pa.Table, column: str, width: int) -> FloatArray:
    """Return a column of lists of ``width`` finite numbers, [rows, width] float32, null as NaN."""
    values = table[column].combine_chunks()
    valid = values.is_valid().to_numpy(zero_copy_only=False).astype(bool)
    lists = values.drop_null()
    try:
        widths = pc.unique(pc.list_value_length(lists)).to_pylist()
        flat = lists.flatten().to_numpy(zero_copy_only=False).astype(np.float32)
    except (pa.ArrowException, AttributeError, TypeError, ValueError):
        flat = None
    if flat is None or widths not in ([], [width]):
        raise DatasetError(f"{name}: {column} must hold {width} numbers a row")
    rows = flat.reshape(-1, width)
    if (bad := np.flatnonzero(~np.isfinite(rows).all(axis=1))).size:
        row = int(np.flatnonzero(valid)[bad[0]])
        raise DatasetError(f"{name}: {column} holds NaN or infinity in row {row}")
    out = np.full((table.num_rows, width), np.nan, dtype=np.float32)
    out[valid] = rows
    return out


def read_rows(
    stem: Path, damage: list[str], columns: Sequence[str]
) -> tuple[pa.Table, NDArray[np.int64]]:
    """Read a table of a flight, complete or not; sentences about lost rows go to ``damage``.

    A complete table is read in these ``columns`` and those of demonstrations, where it has them:
    a stranger's other columns could have any size.

    Returns:
        The readable rows and their indices; for an empty file, no columns.

    Raises:
        DatasetError: there is no such table, none of it can be read, or it has more rows than a
            flight can have.
    """
    parquet, stream = stem.with_suffix(".parquet"), stem.with_suffix(".arrows")
    path = parquet if parquet.exists() else stream
    try:
        if path == stream:
            table, numbers = _read_batches(path, damage)
        else:
            table, numbers = _read_groups(path, damage, (*columns, *_LABELS))
    except FileNotFoundError as error:
        raise DatasetError(
            f"{stem.parent} has neither {parquet.name} nor {stream.name}: it is no whole flight"
        ) from error
    except (pa.ArrowException, OSError) as error:
        raise DatasetError(why_unreadable(path, error)) from error
    if len(set(table.column_names)) < table.num_columns:
        raise DatasetError(f"{path} has two columns of one name: record or convert it again")
    return table, numbers


def _read_batches(path: Path, damage: list[str]) -> tuple[pa.Table, NDArray[np.int64]]:
    """Read the complete batches of a stream that still grew, or was cut off."""
    batches, rows, end, size = [], 0, 0, path.stat().st_size
    if size == 0:  # killed before the first batch
        return pa.table({}), np.zeros(0, np.int64)
    with path.open("rb") as file, pa.ipc.open_stream(file) as reader:
        try:
            while True:
                end = file.tell()
                batches.append(reader.read_next_batch())
                rows += batches[-1].num_rows
                if rows > MAX_ROWS:
                    raise DatasetError(f"{path} has {rows} rows, more rows than a flight has")
        except StopIteration:
            end = size
        except (pa.ArrowException, OSError):
            damage.append(f"{path} is damaged or cut off: its last {size - end} bytes were skipped")
        table = pa.Table.from_batches(batches, schema=reader.schema)
    return table, np.arange(table.num_rows)


def _read_groups(
    path: Path, damage: list[str], columns: Sequence[str]
) -> tuple[pa.Table, NDArray[np.int64]]:
    """Read the undamaged row groups of a Parquet file."""
    groups, numbers, count = [], [np.zeros(0, np.int64)], 0
    failure: Exception | None = None
    with path.open("rb") as raw, pq.ParquetFile(raw, page_checksum_verification=True) as file:
        if file.metadata.num_rows > MAX_ROWS:
            rows = file.metadata.num_rows
            raise DatasetError(f"{path} has {rows} rows, more rows than a flight has")
        schema = file.schema_arrow
        for index in range(file.num_row_groups):
            rows = file.metadata.row_group(index).num_rows
            try:
                groups.append(file.read_row_group(index, columns))
                numbers.append(np.arange(count, count + groups[-1].num_rows))
            except (pa.ArrowException, OSError) as error:
                failure = error
            count += rows
    if failure is not None:
        if not groups:
            raise failure
        lost = count - sum(map(len, numbers))
        damage.append(f"{path} is damaged: {lost} of {count} rows were skipped")
    table = pa.concat_tables(groups) if groups else schema.empty_table()
    return table, np.concatenate(numbers)
