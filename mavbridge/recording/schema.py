"""Arrow schemas of the tables, and records to rows and back. A value that was not there is null."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa

from mavbridge.core.records import Sticks, StickTrace, Tick, VehicleState
from mavbridge.recording.rows import FrameRow, FrameTruth, TickLabels, TickRow
from policy.contract import ACTION_DIM, STATE_DIM

_STICKS = pa.list_(pa.float32(), ACTION_DIM)
_VECTOR = pa.list_(pa.float32(), 3)
_QUATERNION = pa.list_(pa.float32(), 4)


def _fields(kind: pa.DataType, *names: str, nullable: bool) -> list[pa.Field]:
    return [pa.field(name, kind, nullable=nullable) for name in names]


TICKS = pa.schema(
    [
        *_fields(pa.int64(), "index", "due_ns", "woke_ns", "sent_ns", nullable=False),
        pa.field("missed_slots", pa.int32(), nullable=False),
        *_fields(
            pa.int64(), "predict_ns", "feature_frame_id", "feature_captured_ns", nullable=True
        ),
        pa.field("state", pa.list_(pa.float32(), STATE_DIM)),
        *_fields(
            pa.int64(),
            *("attitude_ns", "rate_ns", "velocity_ns", "specific_force_ns"),
            nullable=True,
        ),
        *_fields(_STICKS, "raw", "clipped", "slewed", "smoothed", "sent", nullable=True),
        pa.field("rc_sticks", _STICKS),
        pa.field("rc_channels_us", pa.list_(pa.uint16()), nullable=False),
        *_fields(pa.string(), "release_reason", "mode", nullable=True),
        pa.field("armed", pa.bool_(), nullable=False),
        pa.field("texts", pa.list_(pa.string()), nullable=False),
        pa.field("dropped_before", pa.int32(), nullable=False),
    ]
)
DEMONSTRATION_TICKS = TICKS.append(pa.field("expert", _STICKS))

FRAMES = pa.schema(
    [
        *_fields(pa.int64(), "frame_id", "captured_ns", "ready_ns", nullable=False),
        pa.field("dropped_before", pa.int32(), nullable=False),
    ]
)
DEMONSTRATION_FRAMES = pa.schema(
    [
        *FRAMES,
        pa.field("position_ned_m", _VECTOR),
        pa.field("ned_from_body_wxyz", _QUATERNION),
        pa.field("velocity_ned_mps", _VECTOR),
        pa.field("next_gate", pa.int32()),
        pa.field("gate_body_m", _VECTOR),
        pa.field("gate_yaw_rad", pa.float32()),
        pa.field("gate_after_body_m", _VECTOR),
    ]
)
"""The truth is null as a whole where it was not given: then its position is null."""

_ROWS_AT_ONCE = 4096
_T = TypeVar("_T")


def ticks_batch(rows: Sequence[TickRow], schema: pa.Schema) -> pa.RecordBatch:
    """Rows of the ticks table.

    Args:
        rows: in their order.
        schema: ``TICKS`` or ``DEMONSTRATION_TICKS``.
    """
    return _batch([_tick_values(row) for row in rows], schema)


def frames_batch(rows: Sequence[FrameRow], schema: pa.Schema) -> pa.RecordBatch:
    """Rows of the frames table.

    Args:
        rows: in their order.
        schema: ``FRAMES`` or ``DEMONSTRATION_FRAMES``.
    """
    return _batch([_frame_values(row) for row in rows], schema)


def _batch(rows: list[tuple[object, ...]], schema: pa.Schema) -> pa.RecordBatch:
    columns = [
        pa.array([row[place] for row in rows], type=field.type)
        for place, field in enumerate(schema)
    ]
    return pa.RecordBatch.from_arrays(columns, schema=schema)


def _tick_values(row: TickRow) -> tuple[object, ...]:
    """In the order of ``DEMONSTRATION_TICKS``."""
    tick, state = row.tick, row.tick.state
    trace: tuple[Sticks | None, ...] = (None,) * 4
    if tick.trace is not None:
        trace = (tick.trace.raw, tick.trace.clipped, tick.trace.slewed, tick.trace.smoothed)
    stamps: tuple[int | None, ...] = (None,) * 4
    if state is not None:
        stamps = (state.attitude_ns, state.rate_ns, state.velocity_ns, state.specific_force_ns)
    return (
        *(tick.index, tick.due_ns, tick.woke_ns, tick.sent_ns, tick.missed_slots),
        *(tick.predict_ns, tick.feature_frame_id, tick.feature_captured_ns),
        None if state is None else state.values.tolist(),
        *stamps,
        *trace,
        *(tick.sent, tick.rc_sticks, tick.rc_channels_us),
        *(tick.release_reason, tick.mode, tick.armed, tick.texts),
        row.dropped_before,
        None if row.labels is None else row.labels.expert,
    )


def _frame_values(row: FrameRow) -> tuple[object, ...]:
    """In the order of ``DEMONSTRATION_FRAMES``."""
    truth: tuple[object, ...] = (None,) * 7
    if row.truth is not None:
        t = row.truth
        truth = (
            *(t.position_ned_m, t.ned_from_body_wxyz, t.velocity_ned_mps),
            *(t.next_gate, t.gate_body_m, t.gate_yaw_rad, t.gate_after_body_m),
        )
    return (row.frame_id, row.captured_ns, row.ready_ns, row.dropped_before, *truth)


def read_ticks(table: pa.Table) -> Iterator[TickRow]:
    """Records of a ticks table, whole columns never turned into Python at once."""
    serial = -1
    has_labels = "expert" in table.column_names
    for row in _rows(table):
        serial += 1 + row["dropped_before"]
        labels = TickLabels(expert=_maybe(_sticks, row["expert"])) if has_labels else None
        yield TickRow(_tick(row, serial), row["dropped_before"], labels)


def read_frames(table: pa.Table) -> Iterator[FrameRow]:
    """Records of a frames table."""
    for row in _rows(table):
        yield FrameRow(
            frame_id=row["frame_id"],
            captured_ns=row["captured_ns"],
            ready_ns=row["ready_ns"],
            dropped_before=row["dropped_before"],
            truth=_truth(row) if row.get("position_ned_m") is not None else None,
        )


def _rows(table: pa.Table) -> Iterable[dict[str, Any]]:
    for batch in table.to_batches(max_chunksize=_ROWS_AT_ONCE):
        yield from batch.to_pylist()


def _tick(row: dict[str, Any], serial: int) -> Tick:
    return Tick(
        serial=serial,
        index=row["index"],
        due_ns=row["due_ns"],
        woke_ns=row["woke_ns"],
        missed_slots=row["missed_slots"],
        predict_ns=row["predict_ns"],
        sent_ns=row["sent_ns"],
        feature_frame_id=row["feature_frame_id"],
        feature_captured_ns=row["feature_captured_ns"],
        state=_state(row),
        trace=_trace(row),
        sent=_maybe(_sticks, row["sent"]),
        release_reason=row["release_reason"],
        mode=row["mode"],
        armed=row["armed"],
        rc_channels_us=tuple(row["rc_channels_us"]),
        rc_sticks=_maybe(_sticks, row["rc_sticks"]),
        texts=tuple(row["texts"]),
    )


def _state(row: dict[str, Any]) -> VehicleState | None:
    if row["state"] is None:
        return None
    values = np.array(row["state"], np.float32)
    values.setflags(write=False)
    return VehicleState(
        values=values,
        attitude_ns=row["attitude_ns"],
        rate_ns=row["rate_ns"],
        velocity_ns=row["velocity_ns"],
        specific_force_ns=row["specific_force_ns"],
    )


def _trace(row: dict[str, Any]) -> StickTrace | None:
    if row["raw"] is None:
        return None
    return StickTrace(
        raw=_sticks(row["raw"]),
        clipped=_sticks(row["clipped"]),
        slewed=_sticks(row["slewed"]),
        smoothed=_sticks(row["smoothed"]),
    )


def _truth(row: dict[str, Any]) -> FrameTruth:
    return FrameTruth(
        position_ned_m=_vector(row["position_ned_m"]),
        ned_from_body_wxyz=_quaternion(row["ned_from_body_wxyz"]),
        velocity_ned_mps=_vector(row["velocity_ned_mps"]),
        next_gate=row["next_gate"],
        gate_body_m=_maybe(_vector, row["gate_body_m"]),
        gate_yaw_rad=row["gate_yaw_rad"],
        gate_after_body_m=_maybe(_vector, row["gate_after_body_m"]),
    )


def _maybe(convert: Callable[[list[float]], _T], values: list[float] | None) -> _T | None:
    return None if values is None else convert(values)


def _sticks(values: list[float]) -> Sticks:
    return Sticks(*values)


def _vector(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


def _quaternion(values: list[float]) -> tuple[float, float, float, float]:
    w, x, y, z = values
    return w, x, y, z
