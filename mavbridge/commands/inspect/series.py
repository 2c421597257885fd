"""Ticks and path of a recorded flight as arrays, and the gates along it, for figures and plots."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.course import CourseGate
from mavbridge.core.records import Position
from mavbridge.core.vehicle import ACTION_CLASSES
from mavbridge.recording.flight_folder import RecordedFlight
from mavbridge.recording.rows import FrameRow
from policy.adapters.interface import EULER_NAMES, state_values
from policy.contract import RATE, STATE_NAMES, VELOCITY
from policy.motion.rotation import other_frame

FloatColumn: TypeAlias = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class TickSeries:
    """Values of all N ticks, in NED and FRD for any policy; NaN for missing ones."""

    start_ns: int
    """Wake-up of the first tick, on the clock of all stamps."""
    t_s: FloatColumn
    """[N] wake-ups, in seconds since the first one."""
    action_names: tuple[str, ...]
    """Names of the four numbers of an action, for ``raw``, ``smoothed``, ``sent`` and ``echo``."""
    raw: FloatColumn
    """[N, 4] as output by the policy."""
    smoothed: FloatColumn
    sent: FloatColumn
    """[N, 4] as the message held them."""
    echo: FloatColumn
    """[N, 4] sticks reported by the vehicle: ours or the pilot's."""
    feature_age_ms: FloatColumn
    """[N] time from the exposure to the send."""
    state_age_ms: FloatColumn
    """[N] time from the arrival of the attitude to the send."""
    lateness_ms: FloatColumn
    """[N] time from the slot to its send."""
    velocity_ned_mps: FloatColumn
    """[N, 3]"""
    roll_pitch_yaw_deg: FloatColumn
    """[N, 3]"""
    rate_frd_dps: FloatColumn
    """[N, 3]"""
    position_ned_m: FloatColumn
    """[N, 3] from the estimator's origin."""


def make_series(flight: RecordedFlight) -> TickSeries:
    """Convert the ticks of a flight to arrays."""
    ticks, contract = flight.ticks, flight.meta.contract
    woke_ns = ticks["woke_ns"].to_numpy()
    start_ns = int(woke_ns[0]) if len(woke_ns) else flight.meta.start_ns
    is_flown = ticks["raw"].is_valid()
    is_slot = pc.and_(is_flown, pc.fill_null(ticks["is_slot"], False))

    def flown_ms(later: str, earlier: str, where: pa.ChunkedArray = is_flown) -> FloatColumn:
        lasted_ns = pc.subtract(ticks[later], ticks[earlier])
        return np.asarray(pc.if_else(where, lasted_ns, None), np.float64) / NS_PER_MS

    state = _vectors(ticks["state"])
    if contract is not None and contract.state_frame == "enu_flu":
        state = other_frame(state)
    angles_rad = state_values(list(state.T), STATE_NAMES, EULER_NAMES)
    return TickSeries(
        start_ns=start_ns,
        t_s=(woke_ns - start_ns) / NS_PER_S,
        action_names=ACTION_CLASSES["sticks" if contract is None else contract.action]._fields,
        raw=_vectors(ticks["raw"]),
        smoothed=_vectors(ticks["smoothed"]),
        sent=_vectors(ticks["sent"]),
        echo=_vectors(ticks["rc_sticks"]),
        feature_age_ms=flown_ms("sent_ns", "feature_captured_ns"),
        state_age_ms=flown_ms("sent_ns", "attitude_ns"),
        lateness_ms=np.maximum(flown_ms("sent_ns", "due_ns", is_slot), 0.0),
        velocity_ned_mps=state[:, VELOCITY],
        roll_pitch_yaw_deg=np.degrees(np.stack(angles_rad, axis=-1)),
        rate_frd_dps=np.degrees(state[:, RATE]),
        position_ned_m=_vectors(ticks["position_ned_m"]),
    )


def _vectors(column: pa.ChunkedArray) -> FloatColumn:
    """Return a column of vectors as rows [N, D], NaN for null."""
    rows = np.full((len(column), column.type.list_size), np.nan)
    rows[column.is_valid().to_numpy()] = (
        column.combine_chunks().flatten().to_numpy().reshape(-1, column.type.list_size)
    )
    return rows


@dataclass(frozen=True, kw_only=True)
class Track:
    """Positions in the order of time."""

    t_s: FloatColumn
    """[M] seconds since the first tick."""
    position_ned_m: FloatColumn
    """[M, 3] from the estimator's origin."""

    @property
    def length_m(self) -> float:
        """Length of the path."""
        steps_m = np.linalg.norm(np.diff(self.position_ned_m, axis=0), axis=1)
        return float(steps_m.sum())


def course_gates(seed: int | None) -> tuple[CourseGate, ...]:
    """Return the gates of a simulated course; none without a seed."""
    if seed is None:
        return ()
    from sitl.course import make_course

    return tuple(
        CourseGate(Position(*gate.center_ned_m), gate.yaw_rad, gate.size_m)
        for gate in make_course(seed).gates
    )


def read_track(series: TickSeries, frames: Sequence[FrameRow]) -> Track | None:
    """Return the simulator's true positions, else the positions in the ticks."""
    rows = [
        ((frame.captured_ns - series.start_ns) / NS_PER_S, frame.truth.position_ned_m)
        for frame in frames
        if frame.truth is not None
    ]
    if rows:
        times, positions = zip(*rows, strict=True)
        return Track(t_s=np.array(times), position_ned_m=np.array(positions))
    known = np.isfinite(series.position_ned_m[:, 0])
    if known.any():
        position = series.position_ned_m[known]
        return Track(t_s=series.t_s[known], position_ned_m=position)
    return None
