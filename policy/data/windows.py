"""Windows of evenly spaced frames with states and sticks, the training data of a world model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from policy.contract import ACTION_DIM, NS_PER_S, QUATERNION, STATE_DIM, VELOCITY, FloatArray
from policy.data.flight_data import FlightData, Nanoseconds
from policy.data.interpolation import Indices, Interpolator, nearest
from policy.errors import DatasetError

TOLERANCE = 0.25
"""Largest distance of a frame from its nominal time in a window, relative to the time between two
frames. Below a third: if a window uses every third camera frame, no neighbour can replace a dropped
one."""


@dataclass(frozen=True, kw_only=True)
class Windows:
    """Windows of ``K`` context frames and ``T`` future frames; created by ``find_windows``."""

    frames: Indices
    """[W, K + T], numbered across all flights."""
    actions: FloatArray
    """[W, T, 4] mean sent stick between the preceding frame and each future frame."""
    states: FloatArray
    """[N, 13] at the exposure of each frame of the flights."""

    def __len__(self) -> int:
        return len(self.frames)

    def at(self, rows: Indices) -> "Windows":
        """Return the windows with indices [B]."""
        return replace(self, frames=self.frames[rows], actions=self.actions[rows])

    def among(self, frames: Indices) -> "Windows":
        """Return the windows with all frames in ``frames``; may be empty."""
        return self.at(np.flatnonzero(np.isin(self.frames, frames).all(axis=1)))

    def spread(self, count: int) -> "Windows":
        """Return at most ``count`` windows, evenly spread over all flights."""
        return self.at(np.linspace(0, len(self) - 1, min(count, len(self))).astype(np.int64))


def find_windows(
    flights: Sequence[FlightData], *, context_frames: int, frames: int, frame_dt_s: float
) -> Windows:
    """Find every run of ``context_frames + frames`` frames of one flight, ``frame_dt_s`` apart.

    No window crosses a gap: each of its frames is near its nominal time and has a state.
    """
    dt_ns = round(frame_dt_s * NS_PER_S)
    states, actions, windows, first = [], [], [], 0
    for flight in flights:
        state, known = _states_at_exposures(flight)
        found = _evenly_spaced(flight.captured_ns, known, context_frames + frames, dt_ns)
        states.append(state)
        actions.append(_mean_sticks(flight, found[:, context_frames - 1 :]))
        windows.append(found + first)
        first += len(state)
    every = np.concatenate(windows)
    if len(every) == 0:
        count, hz = context_frames + frames, 1 / frame_dt_s
        gaps_ns = np.concatenate([np.diff(flight.captured_ns) for flight in flights])
        gap_ns = np.median(gaps_ns) if len(gaps_ns) else dt_ns
        raise DatasetError(
            f"{flights[0].name}: no {count} frames with states, {dt_ns / 1e6:.0f} ms apart (its "
            f"{len(flights[0].captured_ns)} frames are {gap_ns / 1e6:.0f} ms apart): fly longer, "
            f"or record {hz:.0f} images a second, or {2 * hz:.0f} and more"
        )
    return Windows(frames=every, actions=np.concatenate(actions), states=np.concatenate(states))


def _states_at_exposures(flight: FlightData) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Interpolate the state [N, 13] at each exposure; return a mask of the known ones too."""
    captured_ns = flight.captured_ns
    state = np.zeros((len(captured_ns), STATE_DIM), np.float32)
    rows = ~np.isnan(flight.state).any(axis=1)
    if not rows.any():
        return state, np.zeros(len(captured_ns), bool)
    flown = flight.state[rows]
    # Body rates come with the attitude; the specific force has the same age within a tick.
    attitude_ns, velocity_ns = flight.attitude_ns[rows], flight.velocity_ns[rows]
    body = Interpolator(attitude_ns, flown[:, QUATERNION.stop :])
    attitude = Interpolator(attitude_ns, flown[:, QUATERNION])
    velocity = Interpolator(velocity_ns, flown[:, VELOCITY])
    quaternion = attitude.rotations_at(captured_ns)
    state[:, VELOCITY] = velocity.vectors_at(captured_ns)
    state[:, QUATERNION] = np.where(quaternion[:, :1] < 0, -quaternion, quaternion)
    state[:, QUATERNION.stop :] = body.vectors_at(captured_ns)
    return state, attitude.covers(captured_ns) & velocity.covers(captured_ns)


def _mean_sticks(flight: FlightData, frames: Indices) -> FloatArray:
    """Return the mean stick [W, T, 4] between neighbours of frames [W, T + 1]; each is held until
    the next one is sent."""
    at_ns, stamps, sticks = flight.captured_ns, flight.sent_ns, flight.sent.astype(np.float64)
    held_s = np.diff(stamps)[:, None] / NS_PER_S
    before = np.concatenate([np.zeros((1, ACTION_DIM)), np.cumsum(sticks[:-1] * held_s, axis=0)])
    row = np.searchsorted(stamps, at_ns, side="right") - 1
    since_s = (at_ns - stamps[np.maximum(row, 0)])[:, None] / NS_PER_S
    integral = before[np.maximum(row, 0)] + sticks[np.maximum(row, 0)] * since_s
    sums = np.where(row[:, None] >= 0, integral, 0.0)  # neutral before the first
    elapsed_s = np.diff(at_ns[frames], axis=1)[..., None] / NS_PER_S
    mean = np.diff(sums[frames], axis=1) / elapsed_s
    return np.clip(mean, -1.0, 1.0).astype(np.float32)


def _evenly_spaced(
    captured_ns: Nanoseconds, usable: NDArray[np.bool_], count: int, dt_ns: int
) -> Indices:
    """Return runs [W, count] of usable frames, each near its nominal time after the first."""
    if len(captured_ns) < count:
        return np.zeros((0, count), np.int64)
    wanted = captured_ns[:, None] + dt_ns * np.arange(count)
    near = nearest(captured_ns, wanted)
    fits = usable[near] & (np.abs(captured_ns[near] - wanted) <= TOLERANCE * dt_ns)
    runs: Indices = near[fits.all(axis=1) & (np.diff(near, axis=1) > 0).all(axis=1)]
    return runs
