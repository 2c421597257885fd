"""Policy inputs at one moment: images of all cameras and states, past observations included."""

from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import FeatureFrame, FloatArray, VehicleState
from mavbridge.flight.ego_motion import EgoMotion
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.state import Unavailable
from policy.contract import Contract

Join: TypeAlias = Callable[[Sequence[Sequence[FloatArray]]], FloatArray]
"""Signature of ``PolicyRunner.join``."""

MAX_STATES = 4096
"""Past states kept: ten seconds of the fastest attitude stream."""


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

    def observe(self, state: VehicleState, now_ns: int) -> Observation | Unavailable:
        """Return the inputs of a chunk from ``state``, the newest pushed; ``Unavailable`` if one is
        missing."""
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

    def _missing(self, camera: int, why: Reason) -> Unavailable:
        """Return ``Unavailable``; of several cameras, name the one."""
        is_only = len(self._cameras) == 1
        name = self._cameras[camera]
        return Unavailable(why if is_only else because(Code.OF_CAMERA, camera=name, why=why))


def observation_ages_ns(contract: Contract) -> tuple[int, ...]:
    """Return the age of each observation relative to the newest [ns], oldest first; the last is
    0."""
    step_ns = round(contract.observation_dt_s * NS_PER_S)
    return tuple(step_ns * steps for steps in reversed(range(contract.observation_steps)))


def _nearest(states: Sequence[VehicleState], at_ns: int) -> VehicleState:
    return min(states, key=lambda state: abs(state.attitude_ns - at_ns))
