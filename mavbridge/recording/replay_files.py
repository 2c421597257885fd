"""Files of a recorded flight for a replay: all settings (``settings.json``), and tables of the
policy's solves, features and packet stamps."""

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa

from mavbridge.config.flight import FlyConfig
from mavbridge.core.files import as_json, from_json
from mavbridge.core.provenance import without_secrets
from mavbridge.core.reasons import reason_to_json
from mavbridge.core.records import FeatureFrame, FloatArray, Solve, VehicleState, VisionTick
from mavbridge.core.vehicle import ForwardedPacket
from mavbridge.recording.rows import attributes, read_reason
from mavbridge.recording.tables import Row, table_rows
from policy.contract import ACTION_DIM, STATE_DIM, Contract
from policy.data.flight_files import SETTINGS
from policy.data.tables import STATE_STAMPS, columns
from policy.errors import DatasetError
from policy.files import read_json

_NUMBERS = pa.list_(pa.float32())
_SOLVE = ("serial", "started_ns", "computed_ns", "reset_ns", "image_ns", "first_ns", "step_ns")
_ARRAYS = ("states", "history", "actions")
_FEATURE = ("frame_id", "captured_ns", "ready_ns")
_V1 = 0xFE
_required = partial(columns, nullable=False)

SOLVES = pa.schema(
    [
        *_required(pa.int64(), *_SOLVE),
        *_required(pa.list_(pa.float32(), STATE_DIM), "state"),
        *_required(pa.int64(), *STATE_STAMPS),
        *_required(pa.list_(pa.float64()), "extras"),
        pa.field("extras_ns", pa.int64()),
        *_required(_NUMBERS, *_ARRAYS),
        *_required(pa.list_(pa.list_(pa.int64())), "frame_ids"),
        *_required(pa.int32(), "dropped_before"),
    ]
)
FEATURES = pa.schema(
    [
        *_required(pa.int64(), *_FEATURE),
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


def solve_columns(solve: Solve, dropped_before: int) -> Row:
    """Convert a solve to a row of ``SOLVES``."""
    return {
        **attributes(solve, (*_SOLVE, "frame_ids")),
        **attributes(solve.state, (*STATE_STAMPS, "extras", "extras_ns")),
        **{name: getattr(solve, name).ravel() for name in _ARRAYS},
        "state": solve.state.values,
        "dropped_before": dropped_before,
    }


def feature_columns(vision: VisionTick, feature: FloatArray, dropped_before: int) -> Row:
    """Convert the feature of a frame to a row of ``FEATURES``."""
    return {
        **attributes(vision, _FEATURE),
        "value": feature.ravel(),
        "fault": None if vision.fault is None else json.dumps(reason_to_json(vision.fault)),
        "dropped_before": dropped_before,
    }


def packet_columns(packet: ForwardedPacket, dropped_before: int) -> Row:
    """Convert a packet to a row of ``PACKETS``."""
    message_id, sequence = packet_key(packet.data)
    return {
        **attributes(packet, ("arrived_ns", "happened_ns")),
        "message_id": message_id,
        "sequence": sequence,
        "dropped_before": dropped_before,
    }


def read_solves(table: pa.Table, contract: Contract) -> Iterator[Solve]:
    """Return the records of a table of solves, with read-only arrays in the contract's shapes."""
    shapes = {
        "states": (1, *contract.state_shape),
        "history": (1, -1, ACTION_DIM),
        "actions": (1, -1, ACTION_DIM),
    }
    for row in table_rows(table, (*_ARRAYS, "state")):
        state = VehicleState(
            values=row["state"],
            extras=tuple(row["extras"]),
            extras_ns=row["extras_ns"],
            **{name: row[name] for name in STATE_STAMPS},
        )
        yield Solve(
            state=state,
            frame_ids=tuple(map(tuple, row["frame_ids"])),
            **{name: row[name] for name in _SOLVE},
            **{name: row[name].reshape(shapes[name]) for name in _ARRAYS},
        )


def read_features(table: pa.Table) -> Iterator[FeatureFrame]:
    """Return the records of a table of features, each with its value [1, F]. Read-only."""
    for row in table_rows(table, ("value",)):
        stored = {"code": None, "data": {}} if row["fault"] is None else json.loads(row["fault"])
        fault = read_reason(stored["code"], json.dumps(stored["data"]))
        stamps = {name: row[name] for name in _FEATURE}
        yield FeatureFrame(value=row["value"][None], fault=fault, **stamps)


def read_packets(table: pa.Table) -> Iterator[PacketStamp]:
    """Return the records of a table of packets."""
    for row in table_rows(table):
        yield PacketStamp(**{name: row[name] for name in PacketStamp._fields})


@dataclass(frozen=True, kw_only=True)
class ReplaySettings:
    """Flags of a flight, including the defaults of flags that were not given."""

    config: FlyConfig
    wall_offset_ns: int
    """Offset from the clock of all stamps to Unix time, as used in ``link.tlog``."""


def write_settings(folder: Path, settings: ReplaySettings) -> None:
    """Write the file; raise OSError if that fails."""
    (folder / SETTINGS).write_text(without_secrets(as_json(settings)))


def read_settings(folder: Path) -> ReplaySettings:
    """Read the file; raise DatasetError if it is missing or not of this version."""
    try:
        return from_json(ReplaySettings, read_json(folder / SETTINGS))
    except FileNotFoundError as error:
        raise DatasetError(
            f"{folder} has no {SETTINGS}: it was recorded by an older mavbridge, or is no flight "
            "of mavbridge fly --record; such a flight cannot be replayed"
        ) from error
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise DatasetError(
            f"{folder / SETTINGS} is damaged, or of another version: {error}"
        ) from error
