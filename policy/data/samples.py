"""Training samples from stamped flights, for any pair of an image and a later tick.

They equal a policy's input in flight, as ``mavbridge.flight`` makes it: its history, the motion
since the exposure, and the times of a chunk's rows.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from policy.contract import (
    ACTION_DIM,
    AGE,
    NS_PER_S,
    QUATERNION,
    RATE,
    ROTATION,
    SPECIFIC_FORCE,
    STATE_DIM,
    VELOCITY,
    VELOCITY_CHANGE,
    Contract,
    FloatArray,
    history_ages_ns,
)
from policy.data.flight_data import GATE_DIM, FlightData, Nanoseconds
from policy.data.interpolation import MAX_GAP_NS, Indices, Interpolator, covered, nearest
from policy.errors import DatasetError
from policy.motion.rotation import motion_since_exposure

TICK_TOLERANCE_NS = 20_000_000
"""Largest distance of a tick from the range of ages: two ticks at 100 Hz."""
HISTORY_JITTER_S = 0.005
"""Largest shift of the history's sampling times, earlier or later: half a tick at 100 Hz."""
FRESH_START_SHARE = 0.15
"""Share of samples as just after takeover: the older part of the history is neutral."""
BLIND_SHARE = 0.4
"""Share of samples without any history.

Sticks change slowly, so a network that sees the last ones learns to copy them instead of looking
(de Haan et al., "Causal Confusion in Imitation Learning", 2019), and then drifts off in flight,
however small its error on the data.
"""
HISTORY_NOISE = 0.1
"""Standard deviation of an offset on the sticks of a history, against copying."""
RATE_NOISE_RADPS = 1.5
FORCE_NOISE_MPS2 = 5.0
"""Standard deviations of the noise that hides body rates and specific force from a network that
flies by rates: both equal the last action a moment later, and are copied like a history."""

_BETWEEN_NS = 10 * NS_PER_S
"""Time between two flights on the common axis: far longer than any gap that is interpolated."""


# In a mirror, the plane of the first and third axis of world and body, vectors change the sign of y
# and rotations the signs of x and z. This holds in both state frames.
_VECTOR, _AXIAL = (1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)
STICK_SIGNS = np.array((1.0, -1.0, 1.0, -1.0), np.float32)
"""Factors of throttle, yaw, pitch and roll in a mirror."""
GATE_SIGNS = np.array((*_VECTOR, -1.0, *_VECTOR), np.float32)
"""Factors of ``FlightData.gate`` in a mirror."""


@dataclass(frozen=True, kw_only=True)
class TrainingSamples:
    """``B`` pairs of an image and a later tick: state [B, state_dim], history [B, K, 4], labels."""

    state: FloatArray
    history: FloatArray
    chunk: FloatArray
    """[B, horizon, 4]; after the end of the flight, its last stick is held."""
    known: NDArray[np.bool_]
    """[B, horizon]: True for the sticks of the chunk that were flown."""
    gate: FloatArray
    """[B, 7] at the exposure, NaN if unknown."""

    def mirrored(self, is_mirrored: NDArray[np.bool_]) -> "TrainingSamples":
        """Exchange left and right in samples with ``is_mirrored`` [B]."""
        return TrainingSamples(
            state=mirrored(self.state, state_signs(self.state.shape[1]), is_mirrored),
            history=mirrored(self.history, STICK_SIGNS, is_mirrored),
            chunk=mirrored(self.chunk, STICK_SIGNS, is_mirrored),
            known=self.known,
            gate=mirrored(self.gate, GATE_SIGNS, is_mirrored),
        )


class Timeline:
    """All flights on one time axis, seconds apart, so that one search serves a batch."""

    def __init__(
        self, flights: Sequence[FlightData], contract: Contract, ages_ns: Nanoseconds
    ) -> None:
        """Lay out the flights in the order in which their images are numbered.

        A sample's image age is drawn from ``ages_ns``, which are sorted.
        """
        gaps_ns = np.concatenate([np.diff(flight.target_ns) for flight in flights])
        if len(gaps_ns) and (gap_ns := np.median(gaps_ns)) > MAX_GAP_NS:
            raise DatasetError(
                f"{flights[0].name}: actions are {gap_ns / 1e6:.0f} ms apart, and a chunk is "
                "learned from 5 or more a second: record at a higher rate"
            )
        self.contract = contract
        self.by_rates = contract.action == "rates"
        self._ages_ns = ages_ns
        starts, offsets = _starts_and_offsets(flights)

        def stamps(name: str) -> Nanoseconds:
            parts = [getattr(e, name) + o for e, o in zip(flights, offsets, strict=True)]
            return np.concatenate(parts).astype(np.int64)

        state = np.concatenate([flight.state for flight in flights])
        known = ~np.isnan(state).any(axis=1)
        self.tick_ns, self._attitude_ns = stamps("tick_ns")[known], stamps("attitude_ns")[known]
        self._state = state[known]
        self._attitude = Interpolator(self._attitude_ns, self._state[:, QUATERNION])
        self._velocity_ns = stamps("velocity_ns")[known]
        self._velocity = Interpolator(self._velocity_ns, self._state[:, VELOCITY])
        self._target_ns = stamps("target_ns")
        self._target = np.concatenate([flight.target for flight in flights])
        # Before its first stick, a flight's sticks were neutral.
        sent_ns = [
            np.concatenate([[start - NS_PER_S], flight.sent_ns + offset])
            for flight, offset, start in zip(flights, offsets, starts, strict=True)
        ]
        neutral = np.zeros((1, ACTION_DIM), np.float32)
        self._sent_ns = np.concatenate(sent_ns).astype(np.int64)
        self._sent = np.concatenate([part for e in flights for part in (neutral, e.sent)])
        self.captured_ns = stamps("captured_ns")
        self.gate = np.concatenate([flight.gate for flight in flights]).reshape(-1, GATE_DIM)
        self._usable_ticks = np.flatnonzero(covered(self._target_ns, self._attitude_ns))
        self.frames, self._any_tick = self._usable_frames()
        if len(self.frames) == 0:
            low_ms, high_ms = ages_ns[[0, -1]] / 1e6
            raise DatasetError(
                f"{flights[0].name}: none of {len(self.captured_ns)} images has a tick with a "
                f"state and sticks to imitate {low_ms:.0f} to {high_ms:.0f} ms after it: too "
                "little of it was flown, or camera and ticks are not of one clock"
            )

    def _usable_frames(self) -> tuple[Indices, Indices]:
        """Return the images with an attitude at the exposure and a later tick; a tick for each."""
        ticks_ns = self.tick_ns[self._usable_ticks]
        low, high = self._tick_range(self.captured_ns)
        first = np.searchsorted(ticks_ns, low, side="left")
        has_tick = first < len(ticks_ns)
        any_tick = np.minimum(first, max(len(ticks_ns) - 1, 0))
        if len(ticks_ns):
            has_tick &= ticks_ns[any_tick] <= high
        has_past = self._attitude.covers(self.captured_ns) & self._velocity.covers(self.captured_ns)
        # The expert knew of gates behind the camera; the image does not show them.
        is_behind = self.gate[:, 0] < 0
        usable = np.flatnonzero(has_tick & has_past & ~is_behind)
        return usable, any_tick

    def _tick_range(self, captured_ns: Nanoseconds) -> tuple[Nanoseconds, Nanoseconds]:
        """Return the first and last time of a tick for each exposure, by the measured ages."""
        low = np.maximum(captured_ns + self._ages_ns[0] - TICK_TOLERANCE_NS, captured_ns)
        return low, captured_ns + self._ages_ns[-1] + TICK_TOLERANCE_NS

    def draw_ticks(self, frames: Indices, random: np.random.Generator) -> Indices:
        """Draw a tick for each image: the nearest to its exposure plus a measured age."""
        ages = self._ages_ns[random.integers(len(self._ages_ns), size=len(frames))]
        wanted = self.captured_ns[frames] + ages
        ticks_ns = self.tick_ns[self._usable_ticks]
        near = nearest(ticks_ns, wanted)
        low, high = self._tick_range(self.captured_ns[frames])
        misses = (ticks_ns[near] < low) | (ticks_ns[near] > high)
        chosen: Indices = self._usable_ticks[np.where(misses, self._any_tick[frames], near)]
        return chosen

    def samples(
        self, frames: Indices, ticks: Indices, random: np.random.Generator | None = None
    ) -> TrainingSamples:
        """Return inputs and labels at ``ticks`` with images ``frames``; augmented by ``random``."""
        chunk, known = self.chunks(ticks)
        state = self.states(frames, ticks)
        if random is not None and self.by_rates:
            for part, spread in ((RATE, RATE_NOISE_RADPS), (SPECIFIC_FORCE, FORCE_NOISE_MPS2)):
                noise = random.normal(0.0, spread, state[:, part].shape)
                state[:, part] += noise.astype(np.float32)
        return TrainingSamples(
            state=state,
            history=self.histories(ticks, random),
            chunk=chunk,
            known=known,
            gate=self.gate[frames],
        )

    def states(self, frames: Indices, ticks: Indices) -> FloatArray:
        """Return states [B, state_dim] at the ticks, with motion since the exposure if needed."""
        state: FloatArray = self._state[ticks]
        if not self.contract.since_exposure:
            return state
        captured_ns, attitude_ns = self.captured_ns[frames], self._attitude_ns[ticks]
        # Image newer than the attitude: in flight no later state is known, so the motion is zero.
        attitude_then = self._attitude.rotations_at(np.minimum(captured_ns, attitude_ns))
        was = self._velocity.vectors_at(np.minimum(captured_ns, self._velocity_ns[ticks]))
        out = np.empty((len(ticks), self.contract.state_dim), np.float32)
        out[:, :STATE_DIM] = state
        out[:, AGE] = (attitude_ns - captured_ns)[:, None] / NS_PER_S
        out[:, ROTATION], out[:, VELOCITY_CHANGE] = motion_since_exposure(
            attitude_then, state[:, QUATERNION].astype(np.float64), state[:, VELOCITY] - was
        )
        return out

    def histories(self, ticks: Indices, random: np.random.Generator | None = None) -> FloatArray:
        """Return the sticks [B, K, 4] as sent, oldest first; augmented by ``random``."""
        count = self.contract.history_len
        ages_ns = np.array(history_ages_ns(count, self.contract.history_dt_s))
        at_ns = self.tick_ns[ticks][:, None] - ages_ns
        if random is not None:
            jitter_s = random.uniform(-HISTORY_JITTER_S, HISTORY_JITTER_S, at_ns.shape)
            at_ns = at_ns - np.round(jitter_s * NS_PER_S).astype(np.int64)
        # Flights are seconds apart, so a time before the first stick finds the neutral row.
        row = np.maximum(np.searchsorted(self._sent_ns, at_ns, side="right") - 1, 0)
        history: FloatArray = self._sent[row]
        if random is None:
            return history
        samples = len(ticks)
        offset = random.normal(0.0, HISTORY_NOISE, (samples, 1, ACTION_DIM))
        history = np.clip(history + offset, -1.0, 1.0).astype(np.float32)
        chance = random.random(samples)
        neutral = np.where(chance < FRESH_START_SHARE, random.integers(1, count + 1, samples), 0)
        neutral = np.where(chance > 1 - BLIND_SHARE, count, neutral)
        is_neutral = (np.arange(count) < neutral[:, None])[..., None]
        return np.where(is_neutral, np.float32(0), history)

    def chunks(self, ticks: Indices) -> tuple[FloatArray, NDArray[np.bool_]]:
        """Return the sticks [B, horizon, 4] to imitate, and a mask [B, horizon] of known ones."""
        horizon = self.contract.horizon
        step_ns = round(self.contract.chunk_dt_s * NS_PER_S)
        at_ns = self._attitude_ns[ticks][:, None] + np.arange(horizon) * step_ns
        known = np.logical_and.accumulate(covered(self._target_ns, at_ns), axis=1)
        flat = at_ns.ravel()
        columns = [np.interp(flat, self._target_ns, column) for column in self._target.T]
        chunk = np.stack(columns, axis=-1).reshape(len(ticks), horizon, ACTION_DIM)
        last = np.maximum(known.sum(axis=1) - 1, 0)
        held = np.minimum(np.arange(horizon), last[:, None])
        filled = np.take_along_axis(chunk, held[..., None], axis=1)
        return filled.astype(np.float32), known


def _starts_and_offsets(flights: Sequence[FlightData]) -> tuple[list[int], list[int]]:
    """Return each flight's start on the common axis, and the offsets to add to its stamps."""
    starts, offsets, end = [], [], 0
    for flight in flights:
        lists = (flight.tick_ns, flight.attitude_ns, flight.velocity_ns, flight.target_ns)
        stamps = np.concatenate([*lists, flight.sent_ns, flight.captured_ns])
        starts.append(end + _BETWEEN_NS)
        offsets.append(starts[-1] - int(stamps.min()))
        end = offsets[-1] + int(stamps.max())
    return starts, offsets


def state_signs(state_dim: int) -> FloatArray:
    """Return the factors [state_dim] of a state in a mirror."""
    signs = np.ones(state_dim, np.float32)
    signs[VELOCITY] = signs[SPECIFIC_FORCE] = _VECTOR
    signs[RATE] = signs[QUATERNION.start + 1 : QUATERNION.stop] = _AXIAL
    if state_dim > STATE_DIM:
        signs[ROTATION] = _AXIAL
        signs[VELOCITY_CHANGE] = _VECTOR
    return signs


def mirrored(values: FloatArray, signs: FloatArray, is_mirrored: NDArray[np.bool_]) -> FloatArray:
    """Multiply the ``values`` [B, ..., D] with ``is_mirrored`` [B] by ``signs`` [D]."""
    chosen = is_mirrored.reshape(-1, *[1] * (values.ndim - 1))
    return np.where(chosen, values * signs, values).astype(np.float32)
