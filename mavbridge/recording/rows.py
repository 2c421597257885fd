"""Rows of a flight's two tables: records, and the conversion from and to columns.

docs/formats.md describes the format. A column is named after the attribute that it holds; a missing
value is null.
"""

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields
from typing import Any, NamedTuple, TypeAlias

import pyarrow as pa

from mavbridge.core.reasons import Reason, reason_from_json, reason_to_json
from mavbridge.core.records import Position, Tick, VehicleState
from mavbridge.core.rotation import Quaternion
from mavbridge.core.vehicle import ACTION_CLASSES, Action, ActionKind, ActionTrace, Sticks
from mavbridge.recording.tables import Row, table_rows
from policy.data.tables import (
    EXPERT_COLUMN,
    FRAME_COLUMNS,
    STATE_STAMPS,
    TICK_COLUMNS,
    TRUTH_COLUMNS,
)
from policy.errors import DatasetError

Vector: TypeAlias = tuple[float, float, float]


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameTruth:
    """The simulator's truth at one exposure: labels for auxiliary losses."""

    position_ned_m: Vector
    ned_from_body_wxyz: Quaternion
    velocity_ned_mps: Vector
    next_gate: int | None
    """Index of the next gate in the course; None after the last."""
    gate_body_m: Vector | None
    """Centre of the next gate in FRD body axes."""
    gate_yaw_rad: float | None
    """Heading of the passage relative to the body's heading."""
    gate_after_body_m: Vector | None
    """Centre of the gate after the next, in FRD body axes."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FrameRow:
    """Facts about a frame, without its pixels."""

    frame_id: int
    captured_ns: int
    ready_ns: int
    dropped_before: int = 0
    """Frames lost just before this one, on the way to the recording."""
    truth: FrameTruth | None = None


class TickRow(NamedTuple):
    """One row of the table of ticks."""

    tick: Tick
    dropped_before: int
    expert: Action | None = None
    """In a demonstration, the expert's action, without the disturbance that was flown."""


_TRUTH = tuple(field.name for field in TRUTH_COLUMNS)
_POSE = _TRUTH[:3]
DEMONSTRATION_TICKS = TICK_COLUMNS.append(EXPERT_COLUMN)
DEMONSTRATION_FRAMES = pa.schema([*FRAME_COLUMNS, *TRUTH_COLUMNS])
_TICK = tuple(
    field.name
    for field in fields(Tick)
    if field.name in TICK_COLUMNS.names and field.name != "release_reason"
)
"""Columns that hold a ``Tick`` attribute unchanged."""


def tick_columns(row: TickRow) -> Row:
    """Convert a tick to a row; ``DEMONSTRATION_TICKS`` alone has a column of the expert."""
    tick = row.tick
    return {
        **attributes(tick, _TICK),
        **_reason_columns(tick.release_reason),
        **attributes(tick.state, STATE_STAMPS),
        **attributes(tick.trace, ActionTrace._fields),
        "state": None if tick.state is None else tick.state.values,
        **attributes(row, ("expert", "dropped_before")),
    }


def _reason_columns(reason: Reason | None) -> Row:
    """Return a reason's columns: the sentence for people, the code and the figures for programs."""
    if reason is None:
        return {}
    document = reason_to_json(reason)
    return {
        "release_reason": document["text"],
        "release_code": document["code"],
        "release_data": json.dumps(document["data"]),
    }


def frame_columns(row: FrameRow) -> Row:
    """Convert a frame to a row; the truth has columns in ``DEMONSTRATION_FRAMES`` only."""
    return attributes(row, FRAME_COLUMNS.names) | attributes(row.truth, _TRUTH)


def attributes(source: object | None, names: Iterable[str]) -> Row:
    """Return the columns that hold attributes unchanged; none if there is no source."""
    return {} if source is None else {name: getattr(source, name) for name in names}


def read_ticks(table: pa.Table, action: ActionKind = "sticks") -> Iterator[TickRow]:
    """Return the ticks of a table with actions of this kind; raise DatasetError for torn ones."""
    for whole, parts in (("state", STATE_STAMPS), ("raw", ActionTrace._fields)):
        there = table.filter(table[whole].is_valid())
        if torn := [name for name in parts if there[name].null_count]:
            raise DatasetError(f"ticks have {whole} without {', '.join(torn)}: see docs/formats.md")
    serial, make = -1, ACTION_CLASSES[action]
    readonly = table.column("sent").null_count == table.num_rows
    for row in table_rows(table, ("state",)):
        serial += 1 + row["dropped_before"]
        expert, tick = row.get("expert"), _tick(row, serial, make, readonly=readonly)
        yield TickRow(tick, row["dropped_before"], expert and make(*expert))


def read_frame_rows(table: pa.Table) -> Iterator[FrameRow]:
    """Return the records of a table of frames."""
    for row in table_rows(table):
        truth = None
        if all(row.get(name) is not None for name in _POSE):
            values: dict[str, Any] = {name: row.get(name) for name in _TRUTH}
            lists = {name: tuple(v) for name, v in values.items() if isinstance(v, list)}
            truth = FrameTruth(**(values | lists))
        yield FrameRow(**{name: row[name] for name in FRAME_COLUMNS.names}, truth=truth)


def _tick(row: dict[str, Any], serial: int, make: type[Action], *, readonly: bool) -> Tick:
    values = {name: row[name] for name in _TICK}
    values |= {name: tuple(row[name]) for name in ("rc_channels_us", "texts")}
    values |= {"release_reason": read_reason(row["release_code"], row["release_data"])}
    # Body rates would keep a lean: outside the policy's flight the guard sends attitudes.
    is_attitude = make is ACTION_CLASSES["rates"] and row["raw"] is None
    sent_as = ACTION_CLASSES["attitude"] if is_attitude else make
    values["sent"] = row["sent"] and sent_as(*row["sent"])
    values["rc_sticks"] = row["rc_sticks"] and Sticks(*row["rc_sticks"])
    if row["position_ned_m"] is not None:
        values["position_ned_m"] = Position(*row["position_ned_m"])
    state, trace = None, None
    if row["state"] is not None:
        state = VehicleState(values=row["state"], **{name: row[name] for name in STATE_STAMPS})
    if row["raw"] is not None:
        trace = ActionTrace(**{name: make(*row[name]) for name in ActionTrace._fields})
    values |= {"serial": serial, "state": state, "trace": trace, "readonly": readonly}
    return Tick(**values)


def read_reason(code: str | None, data: str) -> Reason | None:
    """Restore a reason from its code and its figures in JSON; raise DatasetError if invalid."""
    if code is None:
        return None
    try:
        reason = reason_from_json({"code": code, "data": json.loads(data)})
        str(reason)  # an older version had other figures
        return reason
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"no reason {code!r} with {data} is known here: use the mavbridge that recorded it"
        ) from error
