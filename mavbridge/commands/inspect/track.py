"""The path of a recorded flight, and the gates along it."""

import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

import numpy as np

from mavbridge.commands.inspect.series import FloatColumn, Series
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.course import CourseGate
from mavbridge.core.records import Position
from mavbridge.mavlink.codec.messages import LocalVelocity
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.recording.flight_folder import RecordedFlight
from mavbridge.recording.folder import TLOG
from mavbridge.recording.rows import FrameRow

_STAMP = struct.Struct(">Q")


@dataclass(frozen=True, kw_only=True)
class Track:
    """Positions in the order of time."""

    t_s: FloatColumn
    """[M] seconds since the first tick."""
    position_ned_m: FloatColumn
    """[M, 3] from the estimator's origin."""
    source: Literal["estimator", "simulator"]


def course_gates(seed: int | None) -> tuple[CourseGate, ...]:
    """The gates of a simulated course; none without a seed."""
    if seed is None:
        return ()
    from sitl.course.layout import make_course

    return tuple(
        CourseGate(Position(*gate.center_ned_m), gate.yaw_rad, gate.size_m)
        for gate in make_course(seed).gates
    )


def read_track(flight: RecordedFlight, series: Series, frames: Sequence[FrameRow]) -> Track | None:
    """The simulator's truth, else the positions in the ticks, else those in the telemetry log."""
    rows = [
        ((frame.captured_ns - series.start_ns) / NS_PER_S, frame.truth.position_ned_m)
        for frame in frames
        if frame.truth is not None
    ]
    if rows:
        return _track(rows, "simulator")
    known = np.isfinite(series.position_ned_m[:, 0])
    if known.any():
        return Track(
            t_s=series.t_s[known],
            position_ned_m=series.position_ned_m[known],
            source="estimator",
        )
    rows = list(_logged_positions(flight, series.start_ns))
    return _track(rows, "estimator") if rows else None


def _track(
    rows: Sequence[tuple[float, tuple[float, float, float]]],
    source: Literal["estimator", "simulator"],
) -> Track:
    times, positions = zip(*rows, strict=True)
    return Track(t_s=np.array(times), position_ned_m=np.array(positions), source=source)


def _logged_positions(
    flight: RecordedFlight, start_ns: int
) -> Iterator[tuple[float, tuple[float, float, float]]]:
    """Positions in ``link.tlog``: 8 bytes of Unix time in us, big-endian, before each packet."""
    codec = Codec(source_system=0, source_component=0)
    unix_start_ns = round(datetime.fromisoformat(flight.meta.started_at).timestamp() * NS_PER_S)
    offset_ns = flight.meta.start_ns - unix_start_ns
    for stamp_us, packet in _tlog_packets(flight.folder / TLOG):
        for message in codec.decode_datagram(packet):
            body = message.body
            if isinstance(body, LocalVelocity) and body.position_ned_m is not None:
                at_ns = stamp_us * 1000 + offset_ns
                if at_ns >= start_ns:
                    yield (at_ns - start_ns) / NS_PER_S, body.position_ned_m


def _tlog_packets(path: Path) -> Iterator[tuple[int, bytes]]:
    """Stamps and packets, up to the first that is cut off; none where there is no such file."""
    if not path.is_file():
        return
    data = path.read_bytes()
    at = 0
    while at + _STAMP.size + 3 <= len(data):
        (stamp_us,) = _STAMP.unpack_from(data, at)
        at += _STAMP.size
        length = _packet_length(data[at : at + 3])
        if length is None or at + length > len(data):
            return
        yield stamp_us, data[at : at + length]
        at += length


def _packet_length(head: bytes) -> int | None:
    """Length of a MAVLink packet from its first three bytes; None if it is none."""
    match head[0]:
        case 0xFD:
            return 12 + head[1] + (13 if head[2] & 1 else 0)
        case 0xFE:
            return 8 + head[1]
    return None
