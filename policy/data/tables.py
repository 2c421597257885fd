"""Columns of a flight's tables, and reading them; faults are raised as ``DatasetError``."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from policy.contract import ACTION_DIM, STATE_DIM, FloatArray
from policy.data.flight_files import table_file
from policy.errors import DatasetError
from policy.files import why_unreadable

MAX_ROWS = 10_000_000
"""More than a day at 100 Hz. A small file can claim many more rows and fill the memory."""
_DAMAGED = (pa.ArrowException, OSError)
_STICKS = pa.list_(pa.float32(), ACTION_DIM)
_VECTOR = pa.list_(pa.float32(), 3)
STATE_STAMPS = ("attitude_ns", "rate_ns", "velocity_ns", "specific_force_ns")
TRACE_STAGES = ("raw", "clipped", "slewed", "smoothed")


def columns(kind: pa.DataType, *names: str, nullable: bool = True) -> list[pa.Field]:
    """Return fields of one type."""
    return [pa.field(name, kind, nullable=nullable) for name in names]


TICK_COLUMNS = pa.schema(
    [
        *columns(pa.int64(), "index", "due_ns", "woke_ns", "sent_ns", nullable=False),
        pa.field("missed_slots", pa.int32(), nullable=False),
        *columns(pa.int64(), "predict_ns", "feature_frame_id", "feature_captured_ns"),
        pa.field("state", pa.list_(pa.float32(), STATE_DIM)),
        *columns(pa.int64(), *STATE_STAMPS),
        *columns(_STICKS, *TRACE_STAGES, "sent", "rc_sticks"),
        pa.field("rc_channels_us", pa.list_(pa.uint16()), nullable=False),
        *columns(pa.string(), "release_reason", "release_code", "release_data", "mode"),
        pa.field("armed", pa.bool_(), nullable=False),
        pa.field("texts", pa.list_(pa.string()), nullable=False),
        pa.field("dropped_before", pa.int32(), nullable=False),
        *columns(pa.bool_(), "is_slot", "is_coasting", nullable=False),
        *columns(pa.int64(), "chunk_serial", "chunk_computed_ns"),
        pa.field("phase", pa.string()),
        pa.field("position_ned_m", _VECTOR),
        pa.field("decided_ns", pa.int64()),
    ]
)
EXPERT_COLUMN = pa.field("expert", _STICKS)
"""Of ticks, in demonstrations only."""
FRAME_COLUMNS = pa.schema(
    [
        *columns(pa.int64(), "frame_id", "captured_ns", "ready_ns", nullable=False),
        pa.field("dropped_before", pa.int32(), nullable=False),
    ]
)
TRUTH_COLUMNS = (
    pa.field("position_ned_m", _VECTOR),
    pa.field("ned_from_body_wxyz", pa.list_(pa.float32(), 4)),
    pa.field("velocity_ned_mps", _VECTOR),
    pa.field("next_gate", pa.int32()),
    pa.field("gate_body_m", _VECTOR),
    pa.field("gate_yaw_rad", pa.float32()),
    pa.field("gate_after_body_m", _VECTOR),
)
"""Of frames, in demonstrations only: all null if the truth was not given; otherwise its pose, the
first three, is never null."""


def vectors(name: str, table: pa.Table, column: str) -> FloatArray:
    """Return a column of vectors of finite numbers, [rows, width], null as NaN."""
    out = vectors_or_nan(table[column])
    if (bad := np.flatnonzero(table[column].is_valid() & ~np.isfinite(out).all(axis=1))).size:
        raise DatasetError(f"{name}: {column} holds NaN or infinity in row {bad[0]}")
    return out


def vectors_or_nan(column: pa.ChunkedArray) -> FloatArray:
    """Return a column of vectors, [rows, width], null as NaN."""
    width = column.type.list_size
    out = np.full((len(column), width), np.nan, dtype=np.float32)
    out[column.is_valid().to_numpy()] = pc.list_flatten(column).to_numpy().reshape(-1, width)
    return out


def read_table(
    stem: Path,
    schema: pa.Schema,
    *,
    optional: Iterable[pa.Field] = (),
    damage: list[str] | None = None,
) -> pa.Table:
    """Read a table of a flight, complete or cut off, up to any damage.

    The columns are those of ``schema``, converted to its types, and those of ``optional`` that are
    there: a stranger's other columns could have any size. A sentence about lost rows goes to
    ``damage``.

    Raises:
        DatasetError: there is no such table, none of it can be read, it has more rows than a flight
            can have, lacks a column, or holds a value that does not belong there.
    """
    path, fields = table_file(stem), [*schema, *optional]
    damage = [] if damage is None else damage
    try:
        if path.suffix == ".parquet":
            table = _read_parquet(path, [field.name for field in fields], damage)
        else:
            table = _read_stream(path, damage)
    except FileNotFoundError as error:
        raise DatasetError(
            f"{stem.parent} has neither {stem.name}.parquet nor {path.name}: it is no whole flight"
        ) from error
    except _DAMAGED as error:
        raise DatasetError(why_unreadable(path, error)) from error
    has = table.column_names
    if len(set(has)) < len(has):
        raise DatasetError(f"{path} has two columns of one name: record or convert it again")
    if not has:  # killed before the first batch
        return schema.empty_table()
    if missing := [name for name in schema.names if name not in has]:
        raise DatasetError(
            f"{path} lacks the column{'s' * (len(missing) > 1)} {', '.join(missing)} of "
            "docs/formats.md: another program or version wrote it"
        )
    return conform(path, table, [field for field in fields if field.name in has])


def conform(path: Path, table: pa.Table, fields: Iterable[pa.Field]) -> pa.Table:
    """Return these columns of a table in their types.

    Raises:
        DatasetError: a value does not fit its type, or is null where none may be.
    """
    columns = {}
    for field in fields:
        values, kind = table[field.name], field.type
        try:
            values = values.cast(kind)
        except pa.ArrowException as error:
            is_vector = pa.types.is_fixed_size_list(kind)
            wanted = f"{kind.list_size} numbers a row" if is_vector else str(kind)
            raise DatasetError(
                f"{path}: {field.name} must hold {wanted}, not {values.type} ({error})"
            ) from error
        is_list = pa.types.is_list(kind) or pa.types.is_fixed_size_list(kind)
        nulls = pc.list_flatten(values).null_count if is_list else 0
        if nulls or (values.null_count and not field.nullable):
            raise DatasetError(
                f"{path} holds null in {field.name}: another program or version wrote it"
            )
        columns[field.name] = values
    return pa.table(columns)


def _require_possible(path: Path, rows: int) -> None:
    if rows > MAX_ROWS:
        raise DatasetError(f"{path} has {rows} rows, more rows than a flight has")


def _read_stream(path: Path, damage: list[str]) -> pa.Table:
    """Read the complete batches of a stream that still grew, or was cut off."""
    batches, rows, end, size = [], 0, 0, path.stat().st_size
    if size == 0:
        return pa.table({})
    with path.open("rb") as file, pa.ipc.open_stream(file) as reader:
        try:
            while True:
                end = file.tell()
                batches.append(reader.read_next_batch())
                rows += batches[-1].num_rows
                _require_possible(path, rows)
        except StopIteration:
            pass
        except _DAMAGED:
            damage.append(f"{path} is damaged or cut off: its last {size - end} bytes were skipped")
        return pa.Table.from_batches(batches, schema=reader.schema)


def _read_parquet(path: Path, names: list[str], damage: list[str]) -> pa.Table:
    """Read the columns that a Parquet file has of these, up to its first damaged row group."""
    groups: list[pa.Table] = []
    with path.open("rb") as raw, pq.ParquetFile(raw, page_checksum_verification=True) as file:
        rows = file.metadata.num_rows
        _require_possible(path, rows)
        try:
            for index in range(file.num_row_groups):
                groups.append(file.read_row_group(index, names))
        except _DAMAGED:
            if not groups:
                raise
            lost = rows - sum(group.num_rows for group in groups)
            damage.append(f"{path} is damaged: its last {lost} of {rows} rows were skipped")
        return pa.concat_tables(groups) if groups else file.schema_arrow.empty_table()
