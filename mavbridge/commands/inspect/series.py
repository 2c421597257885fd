"""Ticks and path of a recorded flight as arrays, and the gates along it, for figures and plots."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.course import CourseGate
from mavbridge.core.records import Position, Tick
from mavbridge.recording.flight_folder import RecordedFlight
from mavbridge.recording.rows import FrameRow
from policy.contract import STATE_DIM
from policy.rotation import conjugate, multiply

FloatColumn: TypeAlias = NDArray[np.float64]
_HALF = 0.5**0.5
_ENU_FROM_NED, _FRD_FROM_FLU = (0.0, _HALF, _HALF, 0.0), (0.0, 1.0, 0.0, 0.0)
"""As in ``mavbridge.flight.state``."""


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
    period_ms: FloatColumn
    """[N] time from the send of the slot before, for consecutive slots."""
    velocity_ned_mps: FloatColumn
    """[N, 3]"""
    roll_pitch_yaw_deg: FloatColumn
    """[N, 3]"""
    rate_frd_dps: FloatColumn
    """[N, 3]"""
    position_ned_m: FloatColumn
    """[N, 3] from the estimator's origin."""


def is_gap(last: Tick, tick: Tick) -> bool:
    """True if the recording lacks ticks between these two neighbours."""
    return tick.serial != last.serial + 1


def make_series(flight: RecordedFlight, ticks: Sequence[Tick]) -> TickSeries:
    """Convert the ticks of a flight to arrays."""
    start_ns = ticks[0].woke_ns if ticks else flight.meta.start_ns
    woke_ns = np.array([tick.woke_ns for tick in ticks], np.int64)
    contract = flight.meta.contract
    state = _rows(ticks, STATE_DIM, lambda tick: None if tick.state is None else tick.state.values)
    velocity, attitude, rate = state[:, 0:3], state[:, 3:7], state[:, 7:10]
    if contract is not None and contract.state_frame == "enu_flu":
        velocity = velocity[:, (1, 0, 2)] * (1, 1, -1)
        rate = rate * (1, -1, -1)
        to_ned, to_flu = conjugate(_ENU_FROM_NED), conjugate(_FRD_FROM_FLU)
        left = np.broadcast_to(to_ned, attitude.shape)
        attitude = multiply(multiply(left, attitude), np.broadcast_to(to_flu, attitude.shape))
    names = next((t.sent._fields for t in ticks if t.sent is not None), None)
    return TickSeries(
        start_ns=start_ns,
        t_s=(woke_ns - start_ns) / NS_PER_S,
        action_names=names or ("throttle", "yaw", "pitch", "roll"),
        raw=_rows(ticks, 4, lambda tick: None if tick.trace is None else tick.trace.raw),
        smoothed=_rows(ticks, 4, lambda tick: None if tick.trace is None else tick.trace.smoothed),
        sent=_rows(ticks, 4, lambda tick: tick.sent),
        echo=_rows(ticks, 4, lambda tick: tick.rc_sticks),
        feature_age_ms=_flown_ms(ticks, _feature_age_ns),
        state_age_ms=_flown_ms(
            ticks, lambda t: None if t.state is None else t.sent_ns - t.state.attitude_ns
        ),
        lateness_ms=_flown_ms(ticks, lambda t: max(0, t.sent_ns - t.due_ns) if t.is_slot else None),
        period_ms=_periods_ms(ticks),
        velocity_ned_mps=velocity,
        roll_pitch_yaw_deg=_euler_deg(attitude),
        rate_frd_dps=np.degrees(rate),
        position_ned_m=_rows(ticks, 3, lambda tick: tick.position_ned_m),
    )


def _rows(
    ticks: Sequence[Tick], width: int, value: Callable[[Tick], Iterable[float] | None]
) -> FloatColumn:
    rows = np.full((len(ticks), width), np.nan)
    for row, tick in zip(rows, ticks, strict=True):
        if (found := value(tick)) is not None:
            row[:] = tuple(found)
    return rows


def _flown_ms(ticks: Sequence[Tick], value_ns: Callable[[Tick], int | None]) -> FloatColumn:
    values_ns = [None if tick.trace is None else value_ns(tick) for tick in ticks]
    return np.array(values_ns, np.float64) / NS_PER_MS


def _feature_age_ns(tick: Tick) -> int | None:
    captured_ns = tick.feature_captured_ns
    return None if captured_ns is None else tick.sent_ns - captured_ns


def _periods_ms(ticks: Sequence[Tick]) -> FloatColumn:
    """Return times between the sends of consecutive flown slots without lost ticks."""
    periods_ns = np.full(len(ticks), np.nan)
    last_ns: int | None = None
    for index, tick in enumerate(ticks):
        if tick.trace is None or (index and is_gap(ticks[index - 1], tick)):
            last_ns = None
        if tick.trace is not None and tick.is_slot:
            if last_ns is not None:
                periods_ns[index] = tick.sent_ns - last_ns
            last_ns = tick.sent_ns
    return periods_ns / NS_PER_MS


def _euler_deg(ned_from_frd_wxyz: FloatColumn) -> FloatColumn:
    """Return roll, pitch and yaw of the aerospace sequence (yaw, then pitch, then roll)."""
    w, x, y, z = np.moveaxis(ned_from_frd_wxyz, -1, 0)
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1, 1))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    angles_rad: FloatColumn = np.stack((roll, pitch, yaw), axis=-1)
    return np.degrees(angles_rad)


@dataclass(frozen=True, kw_only=True)
class Track:
    """Positions in the order of time."""

    t_s: FloatColumn
    """[M] seconds since the first tick."""
    position_ned_m: FloatColumn
    """[M, 3] from the estimator's origin."""
    source: Literal["estimator", "simulator"]

    @property
    def length_m(self) -> float:
        """Length of the path."""
        steps = self.position_ned_m[1:] - self.position_ned_m[:-1]
        return float(((steps**2).sum(axis=1) ** 0.5).sum())


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
        return Track(t_s=np.array(times), position_ned_m=np.array(positions), source="simulator")
    known = np.isfinite(series.position_ned_m[:, 0])
    if known.any():
        position = series.position_ned_m[known]
        return Track(t_s=series.t_s[known], position_ned_m=position, source="estimator")
    return None
