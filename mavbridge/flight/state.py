"""The policy's inputs: the contract's state from telemetry, beside images and past states.

Where an input is missing or stale, the result is the ``Reason`` instead.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple, TypeAlias

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because, too_old
from mavbridge.core.records import FeatureFrame, FloatArray, VehicleState
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.plan import FlightPlan
from policy.contract import QUATERNION, VELOCITY, Contract
from policy.motion.rotation import motion_since_exposure, other_frame, slerp

_READINGS = {"goal": "position", "altitude": "position", "height": "height above home"}

LEAST_RATE_RADPS = 1e-4
"""Body rate that excludes a constant attitude: a hundredth of a gyroscope's noise, and above the
residual rate of a noise-free simulator at hover."""

Join: TypeAlias = Callable[[Sequence[Sequence[FloatArray]]], FloatArray]
"""Signature of ``PolicyRunner.join``."""

MAX_STATES = 4096
"""Past states kept: ten seconds of the fastest attitude stream."""
SPARSE_NS = 50 * NS_PER_MS
"""At longer chunk periods the states of the chunks are too sparse for the motion since an
exposure."""


class FrozenStateCheck:
    """Detects a frozen attitude: states keep arriving, but the attitude stays bit-identical.

    It is a fault after ``max_frozen_ns`` if the body rates say that the vehicle turns; 0 disables
    the check.
    """

    def __init__(self, *, max_frozen_ns: int) -> None:
        self._max_frozen_ns = max_frozen_ns
        self._attitude: bytes = b""
        self._changed_ns = 0

    def problem(self, state: VehicleState) -> Reason | None:
        """Return the reason not to fly by this state, or None. Call with each state, in order."""
        attitude = state.values[3:7].tobytes()
        if attitude != self._attitude:
            self._attitude, self._changed_ns = attitude, state.attitude_ns
        frozen_ns = state.attitude_ns - self._changed_ns
        if not self._max_frozen_ns or frozen_ns <= self._max_frozen_ns:
            return None
        if float(np.abs(state.values[7:10]).max()) <= LEAST_RATE_RADPS:
            return None
        age_ms, limit_ms = frozen_ns / NS_PER_MS, self._max_frozen_ns / NS_PER_MS
        return because(Code.ATTITUDE_FROZEN, age_ms=age_ms, limit_ms=limit_ms)


class StateReader:
    """Builds the states of one flight from telemetry.

    Optional inputs have the freshness limit of the velocity; a missing or stale one makes the state
    unavailable.
    """

    def __init__(self, plan: FlightPlan) -> None:
        self._frame = plan.contract.state_frame
        self._extras = plan.contract.state_extras
        self._limits = plan.start_limits
        self._goal_ned_m = plan.config.goal_ned_m

    def motion(self, telemetry: Telemetry, now_ns: int) -> VehicleState | Reason:
        """Join the newest readings into a state without optional inputs.

        A missing or stale reading is a reason, never a zero.
        """
        limits, readings = self._limits, list[Reading]()
        limits_ns = (limits.state_ns, limits.state_ns, limits.velocity_ns, limits.velocity_ns)
        names = ("attitude", "body rate", "velocity", "acceleration")
        for reading, quantity, limit_ns in zip(telemetry.motion, names, limits_ns, strict=True):
            if reading is None or not reading.is_fresh(now_ns, limit_ns):
                return stale(reading, quantity, now_ns, limit_ns)
            readings.append(reading)
        attitude, rate, velocity, force = readings
        row = (*velocity.values, *attitude.values, *rate.values, *force.values)
        if self._frame == "enu_flu":
            row = other_frame(row)
        values = np.array((*row[:3], *_unit_positive(row[3:7]), *row[7:]), dtype=np.float32)
        values.setflags(write=False)
        return VehicleState(
            values=values,
            attitude_ns=attitude.happened_ns,
            rate_ns=rate.happened_ns,
            velocity_ns=velocity.happened_ns,
            specific_force_ns=force.happened_ns,
        )

    def read(
        self, telemetry: Telemetry, now_ns: int, *, has_position: bool
    ) -> VehicleState | Reason:
        """Return the state at ``now_ns``. ``has_position``: the vehicle's position may be
        trusted."""
        state = self.motion(telemetry, now_ns)
        if isinstance(state, Reason) or not self._extras:
            return state
        position = telemetry.position_ned_m if has_position else None
        numbers: list[float] = []
        stamps_ns: list[int] = []
        for extra in self._extras:
            reading = telemetry.height_above_home_m if extra == "height" else position
            if reading is None or not reading.is_fresh(now_ns, self._limits.velocity_ns):
                if reading is None:
                    return because(Code.NO_TRUSTED_READING, quantity=_READINGS[extra])
                return stale(reading, _READINGS[extra], now_ns, self._limits.velocity_ns)
            stamps_ns.append(reading.happened_ns)
            if extra == "goal":
                numbers += self._to_goal(reading.values)
            else:
                numbers.append(reading.values[0] if extra == "height" else -reading.values[2])
        return replace(state, extras=tuple(numbers), extras_ns=min(stamps_ns))

    def _to_goal(self, position_ned_m: tuple[float, ...]) -> list[float]:
        """Return the vector from the vehicle to the goal, in the contract's world frame."""
        assert self._goal_ned_m is not None  # plan_flight requires it
        north, east, down = (
            there - here for there, here in zip(self._goal_ned_m, position_ned_m, strict=True)
        )
        return [north, east, down] if self._frame == "ned_frd" else [east, north, -down]


def stale(reading: Reading | None, quantity: str, now_ns: int, limit_ns: int) -> Reason:
    """Return what is wrong with a missing, stale or future reading."""
    if reading is None:
        return because(Code.NO_READING, quantity=quantity)
    if reading.delay_ns < 0:
        ahead_ms = -reading.delay_ns / NS_PER_MS
        return because(Code.READING_AHEAD, quantity=quantity, ahead_ms=ahead_ms)
    return too_old(quantity, now_ns - reading.happened_ns, limit_ns)


def _unit_positive(q: tuple[float, ...]) -> tuple[float, ...]:
    """Normalise to w >= 0: q and -q are the same attitude, and networks are trained on one of
    them."""
    w, x, y, z = q
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    scale = (-1.0 if w < 0 else 1.0) / norm
    return w * scale, x * scale, y * scale, z * scale


class Observation(NamedTuple):
    """Inputs of one chunk, with their stamps."""

    encoded: FloatArray
    """Encoded images, as ``PolicyRunner.act`` takes them."""
    states: FloatArray
    """States, shape [1, *contract.state_shape]."""
    state: VehicleState
    """Newest state."""
    captured_ns: int
    """Exposure of the first camera's newest image."""
    image_ns: int
    """Oldest exposure among the newest images of all cameras."""
    frame_ids: tuple[tuple[int, ...], ...]
    """Frame ids of the features, [T][cameras], oldest first."""


class ObservationSource:
    """Joins newest and past images and states of one flight; for the policy's thread.

    A past observation is the image, or state, nearest in time to a fixed number of steps before the
    newest one of its camera. At the start of a flight the oldest one is repeated.
    """

    def __init__(
        self, contract: Contract, *, caches: Sequence[FeatureCache], join: Join, max_age_ns: int
    ) -> None:
        """Create an empty source.

        Args:
            contract: number and kind of observations.
            caches: one per camera, in the contract's order.
            join: ``PolicyRunner.join``.
            max_age_ns: oldest image to act on.
        """
        self._cameras = contract.cameras
        self._caches = tuple(caches)
        self._join = join
        self._max_age_ns = max_age_ns
        self._has_motion = contract.since_exposure
        self._before_ns = observation_ages_ns(contract)
        self._span_ns = self._before_ns[0] + (max_age_ns if contract.since_exposure else 0)
        self._states: deque[VehicleState] = deque(maxlen=MAX_STATES)

    def push(self, state: VehicleState) -> None:
        """Add a state, also if no chunk is computed from it; call in order."""
        states = self._states
        attitude_ns, velocity_ns = state.attitude_ns, state.velocity_ns
        if (
            states
            and attitude_ns <= states[-1].attitude_ns
            and velocity_ns <= states[-1].velocity_ns
        ):
            return
        states.append(state)
        # One state from before the span stays: an exposure lies between two.
        while len(states) > 1 and (
            states[1].attitude_ns <= attitude_ns - self._span_ns
            and states[1].velocity_ns <= velocity_ns - self._span_ns
        ):
            states.popleft()

    def observe(
        self, state: VehicleState, now_ns: int, predicted: Sequence[VehicleState] = ()
    ) -> Observation | Reason:
        """Return the inputs of a chunk from ``state``, or why one is missing.

        ``state`` is the newest pushed; or it is predicted, after the ``predicted`` ones.
        """
        newest = []
        for camera, cache in enumerate(self._caches):
            feature = cache.latest()
            if feature is None:
                return self._missing(camera, cache.refusal or because(Code.NO_IMAGE))
            if (age_ns := now_ns - feature.captured_ns) > self._max_age_ns:
                old = too_old("image", age_ns, self._max_age_ns)
                return self._missing(camera, cache.refusal or old)
            if feature.fault is not None:
                return self._missing(camera, feature.fault)
            newest.append(feature)
        rows = [
            [
                feature if before_ns == 0 else cache.nearest(feature, before_ns=before_ns)
                for feature, cache in zip(newest, self._caches, strict=True)
            ]
            for before_ns in self._before_ns
        ]
        return Observation(
            encoded=self._join([[feature.value for feature in row] for row in rows]),
            states=self._rows(state, predicted, [row[0] for row in rows]),
            state=state,
            captured_ns=newest[0].captured_ns,
            image_ns=min(feature.captured_ns for feature in newest),
            frame_ids=tuple(tuple(feature.frame_id for feature in row) for row in rows),
        )

    def _rows(
        self,
        state: VehicleState,
        predicted: Sequence[VehicleState],
        features: Sequence[FeatureFrame],
    ) -> FloatArray:
        """Return the states at the observations; ``features`` are the first camera's."""
        if len(self._before_ns) == 1:
            return self._with_motion(state, features[0])
        known = (*self._states, *predicted, state)
        rows = []
        for before_ns, feature in zip(self._before_ns, features, strict=True):
            at_ns = state.attitude_ns - before_ns
            nearest = min(known, key=lambda each: abs(each.attitude_ns - at_ns))
            past = nearest if before_ns else state
            rows.append(self._with_motion(past, feature)[0])
        return np.stack(rows)[None]

    def _with_motion(self, state: VehicleState, feature: FeatureFrame) -> FloatArray:
        """Return the state with its optional inputs, [1, state_dim]."""
        parts = [state.values]
        if self._has_motion:
            parts.append(motion_since(feature.captured_ns, state, self._states))
        return np.concatenate([*parts, np.array(state.extras, np.float32)])[None]

    def _missing(self, camera: int, why: Reason) -> Reason:
        """Return the reason, with the camera's name if there are several."""
        if len(self._cameras) == 1:
            return why
        return because(Code.OF_CAMERA, camera=self._cameras[camera], why=why)


def observation_ages_ns(contract: Contract) -> tuple[int, ...]:
    """Return the age of each observation relative to the newest [ns], oldest first; the last is
    0."""
    step_ns = round(contract.observation_dt_s * NS_PER_S)
    return tuple(step_ns * steps for steps in reversed(range(contract.observation_steps)))


def keeps_past(plan: FlightPlan) -> bool:
    """True if the states between two solves are needed.

    They are for past observations; and for the motion since an exposure if the states of the solves
    are too sparse.
    """
    is_sparse = plan.guard.chunk_period_ns > SPARSE_NS
    return plan.contract.observation_steps > 1 or (plan.contract.since_exposure and is_sparse)


def motion_since(exposed_ns: int, state: VehicleState, known: Sequence[VehicleState]) -> FloatArray:
    """Return ``contract.SINCE_EXPOSURE_NAMES`` [7] of a state, in its frame.

    Args:
        exposed_ns: exposure of the image. If it is after the attitude, the motion is zero and the
            age negative.
        state: state to which the motion leads.
        known: states in order, at least one.
    """
    before, after, share = _around([s.attitude_ns for s in known], exposed_ns)
    one, other = (tuple(known[k].values[QUATERNION].tolist()) for k in (before, after))
    attitude_then = slerp(one, other, share)
    before, after, share = _around([s.velocity_ns for s in known], exposed_ns)
    one, other = (tuple(known[k].values[VELOCITY].tolist()) for k in (before, after))
    ux, uy, uz = (p + share * (q - p) for p, q in zip(one, other, strict=True))
    vx, vy, vz = state.values[VELOCITY].tolist()
    attitude_now = tuple(state.values[QUATERNION].tolist())
    turn, change = motion_since_exposure(attitude_then, attitude_now, (vx - ux, vy - uy, vz - uz))
    age_s = (state.attitude_ns - exposed_ns) / NS_PER_S
    return np.array((age_s, *turn, *change), np.float32)


def _around(stamps_ns: Sequence[int], at_ns: int) -> tuple[int, int, float]:
    """Return the indices before and after a time, and its position between them, 0 to 1."""
    after = len(stamps_ns) - 1
    for before in range(after, -1, -1):  # from the newest: an image is a few states old
        if stamps_ns[before] <= at_ns:
            between_ns = stamps_ns[after] - stamps_ns[before]
            share = (at_ns - stamps_ns[before]) / between_ns if between_ns else 0.0
            return before, after, share
        after = before
    return after, after, 0.0
