"""The path of a recorded flight, and the gates along it."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

import numpy as np

from mavbridge.commands.inspect.series import FloatColumn, Series
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.course import CourseGate
from mavbridge.core.records import Position
from mavbridge.mavlink.codec.messages import LocalVelocity
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.codec.tlog import Skipped, read_tlog
from mavbridge.recording.flight_folder import RecordedFlight
from mavbridge.recording.folder import TLOG
from mavbridge.recording.rows import FrameRow


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


def read_track(
    flight: RecordedFlight, series: Series, frames: Sequence[FrameRow], damage: list[str]
) -> Track | None:
    """The simulator's truth, else the positions in the ticks, else those in the telemetry log.

    A sentence on what of the log is lost is added to ``damage``.
    """
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
    rows = list(_logged_positions(flight, series.start_ns, damage))
    return _track(rows, "estimator") if rows else None


def _track(
    rows: Sequence[tuple[float, tuple[float, float, float]]],
    source: Literal["estimator", "simulator"],
) -> Track:
    times, positions = zip(*rows, strict=True)
    return Track(t_s=np.array(times), position_ned_m=np.array(positions), source=source)


def _logged_positions(
    flight: RecordedFlight, start_ns: int, damage: list[str]
) -> Iterator[tuple[float, tuple[float, float, float]]]:
    """Positions in ``link.tlog``; none where there is no such file."""
    codec = Codec(source_system=0, source_component=0)
    unix_start_ns = round(datetime.fromisoformat(flight.meta.started_at).timestamp() * NS_PER_S)
    offset_ns = flight.meta.start_ns - unix_start_ns
    if not (flight.folder / TLOG).is_file():
        return
    path, skipped = flight.folder / TLOG, Skipped()
    for stamp_us, packet in read_tlog(path, skipped):
        for message in codec.decode_datagram(packet.data):
            body = message.body
            if isinstance(body, LocalVelocity) and body.position_ned_m is not None:
                at_ns = stamp_us * 1000 + offset_ns
                if at_ns >= start_ns:
                    yield (at_ns - start_ns) / NS_PER_S, body.position_ned_m
    damage += filter(None, [skipped.describe(path)])
