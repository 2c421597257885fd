"""The policy's inputs: the contract's state from telemetry, beside images and past states.

Where an input is missing or stale, the result is the ``Reason`` instead.
"""

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import FeatureFrame, FloatArray, VehicleState
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.flight.ego_motion import EgoMotion
from mavbridge.flight.feature_cache import FeatureCache
from policy.contract import Contract
from policy.motion.rotation import other_frame

StateFrame = Literal["ned_frd", "enu_flu"]
Ned = tuple[float, float, float]
_READINGS = {"goal": "position", "altitude": "position", "height": "height above home"}

LEAST_RATE_RADPS = 1e-4
"""Body rate that excludes a constant attitude: a hundredth of a gyroscope's noise, and above the
residual rate of a noise-free simulator at hover."""

Join: TypeAlias = Callable[[Sequence[Sequence[FloatArray]]], FloatArray]
"""Signature of ``PolicyRunner.join``."""

MAX_STATES = 4096
"""Past states kept: ten seconds of the fastest attitude stream."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Freshness:
    """Maximum age of each kind of reading."""

    attitude_ns: int
    """Attitude and body rates."""
    velocity_ns: int
    """Velocity and specific force."""


def build_state(
    telemetry: Telemetry, now_ns: int, *, frame: StateFrame, freshness: Freshness
) -> VehicleState | Reason:
    """Join the newest readings into a state in ``frame``, the contract's.

    A missing or stale reading is a reason, never a zero.
    """
    attitude, rate = telemetry.ned_from_body_wxyz, telemetry.rate_body_radps
    velocity, force = telemetry.velocity_ned_mps, telemetry.specific_force_body_mps2
    if attitude is None or not attitude.is_fresh(now_ns, freshness.attitude_ns):
        return stale(attitude, "attitude", now_ns, freshness.attitude_ns)
    if rate is None or not rate.is_fresh(now_ns, freshness.attitude_ns):
        return stale(rate, "body rate", now_ns, freshness.attitude_ns)
    if velocity is None or not velocity.is_fresh(now_ns, freshness.velocity_ns):
        return stale(velocity, "velocity", now_ns, freshness.velocity_ns)
    if force is None or not force.is_fresh(now_ns, freshness.velocity_ns):
        return stale(force, "acceleration", now_ns, freshness.velocity_ns)
    row = (*velocity.values, *attitude.values, *rate.values, *force.values)
    if frame == "enu_flu":
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
    """Builds the states of one flight, with the optional inputs of its contract.

    Optional inputs have the freshness limit of the velocity; a missing or stale one makes the state
    unavailable.
    """

    def __init__(
        self, contract: Contract, *, freshness: Freshness, goal_ned_m: Ned | None = None
    ) -> None:
        """``goal_ned_m``: goal relative to the estimator's origin, for a contract that asks for
        one."""
        self._frame = contract.state_frame
        self._extras = contract.state_extras
        self._freshness = freshness
        self._goal_ned_m = goal_ned_m

    def read(
        self, telemetry: Telemetry, now_ns: int, *, has_position: bool
    ) -> VehicleState | Reason:
        """Return the state at ``now_ns``. ``has_position``: the vehicle's position may be
        trusted."""
        state = build_state(telemetry, now_ns, frame=self._frame, freshness=self._freshness)
        if isinstance(state, Reason) or not self._extras:
            return state
        position = telemetry.position_ned_m if has_position else None
        numbers: list[float] = []
        stamps_ns: list[int] = []
        for extra in self._extras:
            reading = telemetry.height_above_home_m if extra == "height" else position
            if reading is None or not reading.is_fresh(now_ns, self._freshness.velocity_ns):
                return self._missing(extra, reading, now_ns)
            stamps_ns.append(reading.happened_ns)
            if extra == "goal":
                numbers += self._to_goal(reading.values)
            else:
                numbers.append(reading.values[0] if extra == "height" else -reading.values[2])
        return replace(state, extras=tuple(numbers), extras_ns=min(stamps_ns))

    def past(self, telemetry: Telemetry, *, has_position: bool) -> VehicleState | None:
        """Return the state at the arrival of the newest attitude; None if it is unavailable."""
        attitude = telemetry.ned_from_body_wxyz
        if attitude is None:
            return None
        state = self.read(telemetry, attitude.arrived_ns, has_position=has_position)
        return state if isinstance(state, VehicleState) else None

    def _missing(self, extra: str, reading: Reading | None, now_ns: int) -> Reason:
        what = _READINGS[extra]
        if reading is None:
            return because(Code.NO_TRUSTED_READING, quantity=what)
        return stale(reading, what, now_ns, self._freshness.velocity_ns)

    def _to_goal(self, position_ned_m: tuple[float, ...]) -> list[float]:
        """Return the vector from the vehicle to the goal, in the contract's world frame."""
        if self._goal_ned_m is None:
            raise ValueError("the contract takes a goal, and the flight has none")
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
    age_ms, limit_ms = (now_ns - reading.happened_ns) / NS_PER_MS, limit_ns / NS_PER_MS
    return because(Code.TOO_OLD, quantity=quantity, age_ms=age_ms, limit_ms=limit_ms)


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
    feature: FeatureFrame
    """Newest feature of the first camera."""
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
        self,
        contract: Contract,
        *,
        caches: Sequence[FeatureCache],
        join: Join,
        max_feature_age_ns: int,
        states_span_ns: int = 0,
    ) -> None:
        """Create an empty source.

        Args:
            contract: number and kind of observations.
            caches: one per camera, in the contract's order.
            join: ``PolicyRunner.join``.
            max_feature_age_ns: oldest image to act on.
            states_span_ns: how far before the newest attitude states are kept.
        """
        self._cameras = contract.cameras
        self._caches = tuple(caches)
        self._join = join
        self._states: deque[VehicleState] = deque(maxlen=MAX_STATES)
        self._span_ns = states_span_ns
        self._max_feature_age_ns = max_feature_age_ns
        self._before_ns = observation_ages_ns(contract)
        self._ego_motion: EgoMotion | None = None
        if contract.since_exposure:
            span_ns = max_feature_age_ns + self._before_ns[0]
            self._ego_motion = EgoMotion(span_ns=span_ns)

    def remember(self, state: VehicleState) -> None:
        """Add a past state that arrived since the last solve; call in order."""
        states = self._states
        if states and state.attitude_ns <= states[-1].attitude_ns:
            return
        states.append(state)
        while len(states) > 1 and states[1].attitude_ns <= state.attitude_ns - self._span_ns:
            states.popleft()
        if self._ego_motion is not None:
            self._ego_motion.push(state)

    def push(self, state: VehicleState) -> None:
        """Add the newest state, also if no chunk is computed from it; call in order."""
        if self._ego_motion is not None:
            self._ego_motion.push(state)

    def observe(self, state: VehicleState, now_ns: int) -> Observation | Reason:
        """Return the inputs of a chunk from ``state``, the newest pushed, or why one is missing."""
        newest = []
        for camera, cache in enumerate(self._caches):
            feature = cache.latest()
            if feature is None:
                return self._missing(camera, because(Code.NO_IMAGE))
            if now_ns - feature.captured_ns > self._max_feature_age_ns:
                age_ms = (now_ns - feature.captured_ns) / NS_PER_MS
                limit_ms = self._max_feature_age_ns / NS_PER_MS
                old = because(Code.TOO_OLD, quantity="image", age_ms=age_ms, limit_ms=limit_ms)
                return self._missing(camera, old)
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
            states=self._rows(state, [row[0] for row in rows]),
            state=state,
            feature=newest[0],
            image_ns=min(feature.captured_ns for feature in newest),
            frame_ids=tuple(tuple(feature.frame_id for feature in row) for row in rows),
        )

    def _rows(self, state: VehicleState, features: Sequence[FeatureFrame]) -> FloatArray:
        """Return the states at the observations; ``features`` are the first camera's."""
        if len(self._before_ns) == 1:
            return self._with_motion(state, features[0])
        known = (*self._states, state)
        rows = []
        for before_ns, feature in zip(self._before_ns, features, strict=True):
            at_ns = state.attitude_ns - before_ns
            past = state if before_ns == 0 else _nearest(known, at_ns)
            rows.append(self._with_motion(past, feature)[0])
        return np.stack(rows)[None]

    def _with_motion(self, state: VehicleState, feature: FeatureFrame) -> FloatArray:
        """Return the state with its optional inputs, [1, state_dim]."""
        row = state.values[None]
        if self._ego_motion is not None:
            row = self._ego_motion.append_to(state, feature.captured_ns)
        if state.extras:
            row = np.append(row, np.array([state.extras], np.float32), axis=1)
        return row

    def _missing(self, camera: int, why: Reason) -> Reason:
        """Of several cameras, name the one."""
        if len(self._cameras) == 1:
            return why
        return because(Code.OF_CAMERA, camera=self._cameras[camera], why=why)


def observation_ages_ns(contract: Contract) -> tuple[int, ...]:
    """Return the age of each observation relative to the newest [ns], oldest first; the last is
    0."""
    step_ns = round(contract.observation_dt_s * NS_PER_S)
    return tuple(step_ns * steps for steps in reversed(range(contract.observation_steps)))


def _nearest(states: Sequence[VehicleState], at_ns: int) -> VehicleState:
    return min(states, key=lambda state: abs(state.attitude_ns - at_ns))
