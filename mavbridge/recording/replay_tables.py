"""Tables for a replay: solves of the policy, features, and packet stamps."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
import pyarrow as pa

from mavbridge.core.observers import BoundedQueue
from mavbridge.core.reasons import reason_to_json
from mavbridge.core.records import FeatureFrame, FloatArray, Solve, VehicleState, VisionTick
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.recording.folder import PACKETS as PACKETS_STEM
from mavbridge.recording.folder import SOLVES as SOLVES_STEM
from mavbridge.recording.folder import features_of
from mavbridge.recording.rows import read_reason
from mavbridge.recording.tables import TableWriter
from policy.contract import ACTION_DIM, STATE_DIM, Contract

_NUMBERS = pa.list_(pa.float32())
_STATE_STAMPS = ("attitude_ns", "rate_ns", "velocity_ns", "specific_force_ns")
_PLAIN = ("serial", "started_ns", "computed_ns", "reset_ns", "image_ns", "first_ns", "step_ns")
_ARRAYS = ("states", "history", "actions")
_V1 = 0xFE


def _required(kind: pa.DataType, *names: str) -> list[pa.Field]:
    return [pa.field(name, kind, nullable=False) for name in names]


SOLVES = pa.schema(
    [
        *_required(pa.int64(), *_PLAIN),
        *_required(pa.list_(pa.float32(), STATE_DIM), "state"),
        *_required(pa.int64(), *_STATE_STAMPS),
        *_required(pa.list_(pa.float64()), "extras"),
        pa.field("extras_ns", pa.int64()),
        *_required(_NUMBERS, *_ARRAYS),
        *_required(pa.list_(pa.list_(pa.int64())), "frame_ids"),
        *_required(pa.int32(), "dropped_before"),
    ]
)
FEATURES = pa.schema(
    [
        *_required(pa.int64(), "frame_id", "captured_ns", "ready_ns"),
        *_required(_NUMBERS, "value"),
        pa.field("fault", pa.string()),
        *_required(pa.int32(), "dropped_before"),
    ]
)
PACKETS = pa.schema(
    [
        *_required(pa.int64(), "arrived_ns", "happened_ns"),
        *_required(pa.int32(), "message_id"),
        *_required(pa.uint8(), "sequence"),
        *_required(pa.int32(), "dropped_before"),
    ]
)


class FeatureRow(NamedTuple):
    """One feature of one camera."""

    frame: FeatureFrame
    dropped_before: int


class SolveRow(NamedTuple):
    """One solve, and the number of unrecorded solves before it."""

    solve: Solve
    dropped_before: int


class PacketStamp(NamedTuple):
    """Arrival of one packet of ``link.tlog``, and the time that its contents describe."""

    arrived_ns: int
    happened_ns: int
    message_id: int
    sequence: int


def packet_key(data: bytes) -> tuple[int, int]:
    """Return message id and sequence number of a complete MAVLink packet."""
    if data[0] == _V1:
        return data[5], data[2]
    return int.from_bytes(data[7:10], "little"), data[4]


def solves_batch(rows: Sequence[SolveRow]) -> pa.RecordBatch:
    """Convert consecutive solves to rows."""
    solves = [row.solve for row in rows]
    states = [solve.state for solve in solves]
    columns: dict[str, Any] = {name: [getattr(solve, name) for solve in solves] for name in _PLAIN}
    columns |= {name: [getattr(state, name) for state in states] for name in _STATE_STAMPS}
    columns |= {name: _lists([getattr(solve, name) for solve in solves]) for name in _ARRAYS}
    columns["state"] = pa.FixedSizeListArray.from_arrays(
        _joined([state.values for state in states]), STATE_DIM
    )
    columns["extras"] = [list(state.extras) for state in states]
    columns["extras_ns"] = [state.extras_ns for state in states]
    columns["frame_ids"] = [[list(ids) for ids in solve.frame_ids] for solve in solves]
    columns["dropped_before"] = [row.dropped_before for row in rows]
    return _batch(columns, SOLVES)


def features_batch(rows: Sequence[FeatureRow]) -> pa.RecordBatch:
    """Convert consecutive features of one camera to rows."""
    frames = [row.frame for row in rows]
    names = ("frame_id", "captured_ns", "ready_ns")
    columns: dict[str, Any] = {name: [getattr(frame, name) for frame in frames] for name in names}
    columns["fault"] = [
        None if frame.fault is None else json.dumps(reason_to_json(frame.fault)) for frame in frames
    ]
    columns["value"] = _lists([frame.value for frame in frames])
    columns["dropped_before"] = [row.dropped_before for row in rows]
    return _batch(columns, FEATURES)


def packets_batch(packets: Sequence[ForwardedPacket], dropped: int) -> pa.RecordBatch:
    """Convert consecutive packets to rows. ``dropped`` packets were lost before the first."""
    keys = [packet_key(packet.data) for packet in packets]
    columns = {
        "arrived_ns": [packet.arrived_ns for packet in packets],
        "happened_ns": [packet.happened_ns for packet in packets],
        "message_id": [key[0] for key in keys],
        "sequence": [key[1] for key in keys],
        "dropped_before": [0 if number else dropped for number in range(len(packets))],
    }
    return _batch(columns, PACKETS)


def _batch(columns: dict[str, Any], schema: pa.Schema) -> pa.RecordBatch:
    arrays = [
        column if isinstance(column, pa.Array) else pa.array(column, field.type)
        for field in schema
        for column in (columns[field.name],)
    ]
    return pa.RecordBatch.from_arrays(arrays, schema=schema)


def _joined(arrays: Sequence[FloatArray]) -> FloatArray:
    """Join all numbers in one array. Arrow takes a numpy array without copying each number."""
    return np.concatenate([np.zeros(0, np.float32), *(array.ravel() for array in arrays)])


def _lists(arrays: Sequence[FloatArray]) -> pa.Array:
    ends = np.cumsum([0, *(array.size for array in arrays)], dtype=np.int32)
    return pa.ListArray.from_arrays(pa.array(ends), pa.array(_joined(arrays)))


def read_solves(table: pa.Table, contract: Contract) -> Iterator[SolveRow]:
    """Return the records of a table of solves, with read-only arrays in the contract's shapes."""
    shapes = {
        "states": (1, *contract.state_shape),
        "history": (1, -1, ACTION_DIM),
        "actions": (1, -1, ACTION_DIM),
    }
    for batch in table.to_batches():
        arrays: dict[str, list[Any]] = {
            name: _arrays(batch.column(name)) for name in (*_ARRAYS, "state")
        }
        rows = batch.drop_columns([*_ARRAYS, "state"]).to_pylist()
        for number, row in enumerate(rows):
            state = VehicleState(
                values=arrays["state"][number],
                extras=tuple(row["extras"]),
                extras_ns=row["extras_ns"],
                **{name: row[name] for name in _STATE_STAMPS},
            )
            solve = Solve(
                state=state,
                frame_ids=tuple(map(tuple, row["frame_ids"])),
                **{name: row[name] for name in _PLAIN},
                **{name: arrays[name][number].reshape(shapes[name]) for name in _ARRAYS},
            )
            yield SolveRow(solve, row["dropped_before"])


def read_features(table: pa.Table) -> Iterator[FeatureFrame]:
    """Return the records of a table of features, each with its value [1, F]. Read-only."""
    for batch in table.to_batches():
        values = _arrays(batch.column("value"))
        for value, row in zip(values, batch.drop_columns(["value"]).to_pylist(), strict=True):
            del row["dropped_before"]
            fault = row.pop("fault")
            stored = {"code": None, "data": {}} if fault is None else json.loads(fault)
            reason = read_reason(stored["code"], json.dumps(stored["data"]))
            yield FeatureFrame(value=value[None], fault=reason, **row)


def read_packets(table: pa.Table) -> Iterator[PacketStamp]:
    """Return the records of a table of packets."""
    for batch in table.to_batches():
        for row in batch.drop_columns(["dropped_before"]).to_pylist():
            yield PacketStamp(**row)


def _arrays(column: pa.Array) -> list[FloatArray]:
    found = [np.asarray(each.values, np.float32) for each in column]
    for array in found:
        array.setflags(write=False)
    return found


PACKET_CAPACITY = 60_000
"""Capacity of the queue of packet stamps: one minute of the busiest link."""
_Row = TypeVar("_Row")


class _Buffered(Generic[_Row]):
    """A table, and the rows that have not been written to it yet."""

    def __init__(self, stem: Path, schema: pa.Schema) -> None:
        self.table = TableWriter(stem, schema)
        self.table.append(pa.RecordBatch.from_pylist([], schema=schema))
        self.rows: list[_Row] = []
        self.serial = -1

    def dropped_before(self, serial: int) -> int:
        """Return the number of rows between the last serial number and this one."""
        dropped, self.serial = serial - self.serial - 1, serial
        return dropped

    def take(self) -> list[_Row]:
        """Remove and return the rows, so that a failed write is not retried."""
        rows, self.rows = self.rows, []
        return rows


class ReplayTables:
    """Tables for a replay. Used by the recorder's thread, except for ``packets.put``.

    Methods raise OSError if a file cannot be written; everything written before stays readable.
    """

    def __init__(self, folder: Path, cameras: tuple[str, ...], *, has_features: bool) -> None:
        """Create the tables in the folder of a flight.

        Args:
            folder: of the flight.
            cameras: in the contract's order.
            has_features: the policy has features, not only resized images.
        """
        self._solves: _Buffered[SolveRow] = _Buffered(folder / SOLVES_STEM, SOLVES)
        self._solves.serial = 0  # the first solve has serial 1
        self._packets = TableWriter(folder / PACKETS_STEM, PACKETS)
        self._packets_lost = 0
        names = (None, *cameras[1:]) if has_features else ()
        self._features: list[_Buffered[FeatureRow]] = [
            _Buffered(folder / features_of(name), FEATURES) for name in names
        ]
        self.packets: BoundedQueue[tuple[ForwardedPacket, ...]] = BoundedQueue(PACKET_CAPACITY)
        """Groups of packets in order of arrival; filled by another thread."""

    def solve(self, solve: Solve) -> None:
        """Record a solve. Skipped serial numbers count as dropped."""
        dropped = self._solves.dropped_before(solve.serial)
        self._solves.rows.append(SolveRow(solve, dropped))

    def feature(self, vision: VisionTick) -> None:
        """Record a feature of any camera if the policy has features."""
        if not self._features or vision.feature is None:
            return
        table = self._features[vision.camera]
        frame = FeatureFrame(
            frame_id=vision.frame_id,
            captured_ns=vision.captured_ns,
            ready_ns=vision.ready_ns,
            value=vision.feature,
            fault=vision.fault,
        )
        table.rows.append(FeatureRow(frame, table.dropped_before(vision.serial)))

    def flush(self) -> None:
        """Hand all rows to the kernel."""
        if solves := self._solves.take():
            self._solves.table.append(solves_batch(solves))
        for features in self._features:
            if rows := features.take():
                features.table.append(features_batch(rows))
        if packets := [packet for group in self.packets.take() for packet in group]:
            lost, self._packets_lost = (
                self.packets.dropped - self._packets_lost,
                self.packets.dropped,
            )
            self._packets.append(packets_batch(packets, lost))

    def finish(self) -> None:
        """Write the remaining rows, and convert the tables to Parquet."""
        self.flush()
        for table in self._tables:
            table.finish()

    def abandon(self) -> None:
        """Leave the tables as they are, after an error."""
        for table in self._tables:
            table.abandon()

    @property
    def _tables(self) -> list[TableWriter]:
        return [self._packets, self._solves.table, *(each.table for each in self._features)]
