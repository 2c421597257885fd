"""Fast path: newest attitude, cached feature and sent actions become a chunk for the guard."""

import math
import threading
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import FloatArray, Solve, VehicleState
from mavbridge.core.vehicle import Action, Reading, Telemetry
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.history import ActionFrame, SentHistory
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.state import (
    FrozenStateCheck,
    Observation,
    ObservationSource,
    observation_ages_ns,
)
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.chunks import Chunk
from mavbridge.guard.values import Phase
from policy.contract import ACTION_DIM
from policy.errors import NoChunkError
from policy.files import last_line
from policy.motion.forward_motion import ForwardMotion, VehicleMotion
from policy.protocol import PolicyRunner

WAIT_NS = 100 * NS_PER_MS
"""Longest wait for an attitude before the stop flag is checked and the guard is told."""

RETRY_NS = 100 * NS_PER_MS
"""Longest pause after a solve that was refused, for slow policies too."""

RECENT_SOLVES = 5
"""Solves whose median duration tells when the next chunk will act."""


class PolicyLoop:
    """Solves on each new attitude, at most at the policy's rate, in its own thread.

    It also solves before the flight: the guard engages only with a fresh chunk.
    """

    def __init__(
        self,
        plan: FlightPlan,
        runner: PolicyRunner,
        *,
        clock: Clock,
        view: TelemetryCache,
        caches: Sequence[FeatureCache],
        send: Callable[[Chunk | Reason], object],
        watches: Sequence[Callable[[Solve], object]] = (),
    ) -> None:
        """Join a policy, telemetry and the caches of its cameras, in the contract's order.

        ``send`` hands a chunk to the guard, or the reason why there is none; ``watches`` are given
        every solve, and must not block.
        """
        contract = plan.contract
        self._runner = runner
        self._clock = clock
        self._view = view
        self._observations = ObservationSource(
            contract, caches=caches, join=runner.join, max_age_ns=plan.start_limits.feature_ns
        )
        self._send = send
        self._watches = watches
        self._action_frame = ActionFrame(contract)
        self._guard = plan.guard
        self._step_ns = round(contract.chunk_dt_s * NS_PER_S)
        self._horizon = contract.horizon
        self._prefix_len = contract.prefix_len
        self._period_ns = plan.guard.chunk_period_ns
        """Minimum mean period of solves. Attitudes that arrive close together may shorten a single
        one."""
        self._forward = ForwardMotion(contract) if contract.state_time == "execution" else None
        """Predicts the state to the time at which the chunk acts."""
        self._before_ns = observation_ages_ns(contract)
        self._frozen = FrozenStateCheck(
            max_frozen_ns=round(plan.config.limits.max_frozen_state * NS_PER_S)
        )
        self._serial = 0
        self._chunk: Chunk | None = None
        """Last chunk that was sent."""
        self._solves_ns: deque[int] = deque(maxlen=RECENT_SOLVES)
        """Durations of the last solves."""
        self._reset_ns = 0
        self._seen_ns = 0
        """Arrival of the newest attitude at the last step."""
        self._due_ns: int | None = None
        """Slot of the next solve. An attitude up to a quarter of a period earlier starts it."""
        self.alive_ns = clock.now_ns()
        """End of the last step; read by another thread."""

    def run(self, stop: threading.Event) -> None:
        """Solve until ``stop`` is set. On an error, tell the guard that no more chunks will
        come."""
        try:
            self._run(stop)
        except BaseException:
            with suppress(Exception):  # no memory: the first error is the one to raise
                self._send(because(Code.POLICY_FAILED))
            raise

    def _run(self, stop: threading.Event) -> None:
        self.alive_ns = self._clock.now_ns()
        while not stop.is_set():
            looks_ns = self._clock.now_ns() + WAIT_NS
            self._clock.sleep_until_ns(min(self.start_ns, looks_ns))
            if self.start_ns > looks_ns:
                pass  # a slow policy: the stop flag is looked at meanwhile
            elif self._view.wait_for_attitude(
                self._clock, newer_than_ns=self.start_ns - 1, timeout_ns=WAIT_NS
            ):
                self.step()
            else:
                self._send(because(Code.NO_READING, quantity="attitude"))
            self.alive_ns = self._clock.now_ns()

    @property
    def start_ns(self) -> int:
        """Earliest arrival of an attitude that starts the next solve."""
        if self._due_ns is None or self._is_starting:
            return self._seen_ns + 1
        return self._due_ns - self._period_ns // 4

    @property
    def _is_starting(self) -> bool:
        """True while the guard waits for a reset and the first chunk after it."""
        return self._view.starting_ns > self._reset_ns

    @property
    def has_news(self) -> bool:
        """True if an attitude has arrived that starts the next solve."""
        return self._view.telemetry.attitude_arrived_ns >= self.start_ns

    def step(self) -> None:
        """Solve once from the newest inputs, or tell the guard why that is impossible."""
        now_ns, is_starting = self._clock.now_ns(), self._is_starting
        telemetry, has_position = self._view.telemetry, self._view.status.has_position
        self._seen_ns = telemetry.attitude_arrived_ns
        due_ns = now_ns if self._due_ns is None or is_starting else self._due_ns
        # A hundredth of tolerance for the vehicle's clock; after a pause the grid starts anew.
        self._due_ns = max(due_ns, now_ns - self._period_ns // 2) + self._period_ns * 99 // 100
        if is_starting:
            self._reset_ns = now_ns
            self._runner.reset()
        for past in self._view.take_past(self._seen_ns):
            arrived_ns = past.attitude_arrived_ns
            before = self._view.reader.read(past, arrived_ns, has_position=has_position)
            if isinstance(before, VehicleState):
                self._observations.push(before)
        state = self._view.reader.read(telemetry, now_ns, has_position=has_position)
        if isinstance(state, Reason):
            self._refuse(state)
            return
        plan = self._chunk if self._view.phase is Phase.FLYING else None
        ahead: SentHistory | None = None
        if self._forward is not None and plan is not None:
            acts_ns = self._takeover_ns(now_ns)
            ahead = self._view.history.foreseen(plan, self._guard, now_ns, acts_ns)
        observation = self._observe(state, telemetry, now_ns, ahead)
        if isinstance(observation, Reason):
            self._refuse(observation)
        else:
            self._solve(state, observation, now_ns, plan, ahead)

    def _observe(
        self, state: VehicleState, telemetry: Telemetry, now_ns: int, ahead: SentHistory | None
    ) -> Observation | Reason:
        self._observations.push(state)
        if (frozen := self._frozen.problem(state)) is not None:
            return frozen
        predicted: list[VehicleState] = []
        if self._forward is not None and ahead is not None:
            acts_ns = self._takeover_ns(now_ns)
            for before_ns in self._before_ns:
                at_ns = acts_ns - before_ns
                then = rolled_forward(self._forward, telemetry, at_ns, ahead.at)
                if then is telemetry:  # measured by then, or the vehicle stands still
                    continue
                has_position = self._view.status.has_position
                acting = self._view.reader.read(then, at_ns, has_position=has_position)
                if isinstance(acting, Reason):
                    return acting
                predicted.append(acting)
        state = predicted.pop() if predicted else state
        return self._observations.observe(state, now_ns, predicted)

    def _takeover_ns(self, now_ns: int) -> int:
        """Return when the chunk of a solve that begins now will take over, by the last solves."""
        solves_ns = sorted(self._solves_ns)
        return now_ns + (solves_ns[len(solves_ns) // 2] if solves_ns else 0)

    def _refuse(self, reason: Reason) -> None:
        if self._due_ns is not None:
            soon_ns = self._clock.now_ns() + RETRY_NS + self._period_ns // 4
            self._due_ns = min(self._due_ns, soon_ns)
        self._send(reason)

    def _solve(
        self,
        state: VehicleState,
        observation: Observation,
        now_ns: int,
        plan: Chunk | None,
        ahead: SentHistory | None,
    ) -> None:
        """Compute and send a chunk.

        ``observation`` may be predicted, ``state`` is as measured; ``plan`` is the chunk that
        flies, if one does; ``ahead`` foresees its actions, for an observation that is predicted.
        """
        acts_ns = observation.state.attitude_ns
        sent, at_ns = (self._view.history, now_ns) if ahead is None else (ahead, acts_ns)
        history = sent.resample(at_ns)
        if self._prefix_len:
            times_ns = range(acts_ns, acts_ns + self._prefix_len * self._step_ns, self._step_ns)
            prefix = self._view.history.committed(plan, times_ns, self._takeover_ns(now_ns))
            history = np.concatenate([history, prefix], axis=1)
        try:
            array = self._runner.act(observation.encoded, observation.states, history)
        except NoChunkError as error:
            self._refuse(because(Code.POLICY_REFUSED, said=last_line(error)))
            return
        done_ns = self._clock.now_ns()
        if array.shape != (1, self._horizon, ACTION_DIM):
            shape = str(list(array.shape))
            self._refuse(because(Code.WRONG_SHAPE, shape=shape, most=self._horizon))
            return
        self._serial += 1
        self._solves_ns.append(done_ns - now_ns)
        solve = Solve(
            serial=self._serial,
            started_ns=now_ns,
            computed_ns=done_ns,
            reset_ns=self._reset_ns,
            state=state,
            states=_kept(observation.states),
            history=_kept(history),
            frame_ids=observation.frame_ids,
            image_ns=observation.image_ns,
            first_ns=acts_ns,
            step_ns=self._step_ns,
            actions=_kept(array),
        )
        self._view.remember(solve, observation.captured_ns)
        chunk = chunk_of(solve, self._action_frame)
        if np.isfinite(array).all():  # else the guard flies on by the one before
            self._chunk = chunk
        self._send(chunk)
        for watch in self._watches:
            watch(solve)


def chunk_of(solve: Solve, frame: ActionFrame) -> Chunk:
    """Return the chunk of a solve, with the oldest stamp of each input that it came from.

    ``frame``: axes of the policy's actions.
    """
    state = solve.state
    velocity_ns = min(state.velocity_ns, state.specific_force_ns)
    return Chunk(
        serial=solve.serial,
        attitude_ns=min(state.attitude_ns, state.rate_ns),
        velocity_ns=velocity_ns if state.extras_ns is None else min(velocity_ns, state.extras_ns),
        image_ns=solve.image_ns,
        computed_ns=solve.computed_ns,
        first_ns=solve.first_ns,
        step_ns=solve.step_ns,
        actions=frame.to_guard(solve.actions[0]),
        reset_ns=solve.reset_ns,
    )


def _kept(array: FloatArray) -> FloatArray:
    """Return a copy: engines may write their next result into the same memory."""
    copy = array.copy()
    copy.setflags(write=False)
    return copy


STEP_NS = 10 * NS_PER_MS
"""Step of the prediction."""
LEAST_SPEED_MPS = 0.3
"""A slower vehicle may stand on the ground, where the model would let it fall."""


def rolled_forward(
    model: ForwardMotion, telemetry: Telemetry, until_ns: int, flown_at: Callable[[int], Action]
) -> Telemetry:
    """Return the telemetry at ``until_ns``; as it is for a vehicle that stands still.

    Each reading is predicted from the attitude's time, and counts as measured at ``until_ns``.
    Positions and heights move with the velocity.

    ``flown_at`` returns the action that the vehicle flies at a time [ns]: sent already, or planned.
    """
    attitude, rate, velocity, force = telemetry.motion
    if attitude is None or rate is None or velocity is None or force is None:
        return telemetry
    now_ns = attitude.happened_ns
    steps = max(round((until_ns - now_ns) / STEP_NS), 1)
    dt_ns = (until_ns - now_ns) // steps
    if dt_ns <= 0 or math.hypot(*velocity.values) < LEAST_SPEED_MPS:
        return telemetry
    w, x, y, z = attitude.values
    start = VehicleMotion((w, x, y, z), _three(rate), _three(velocity), _three(force))
    actions = [flown_at(now_ns + step * dt_ns) for step in range(steps)]
    end = model.after(start, actions, dt_ns / NS_PER_S)
    half_s = (until_ns - now_ns) / NS_PER_S / 2
    north, east, down = (
        half_s * (v + u) for v, u in zip(start.velocity_ned_mps, end.velocity_ned_mps, strict=True)
    )
    return Telemetry(
        Reading(until_ns, end.ned_from_body_wxyz),
        Reading(until_ns, end.rate_body_radps),
        Reading(until_ns, end.velocity_ned_mps),
        Reading(until_ns, end.specific_force_body_mps2),
        position_ned_m=_moved(telemetry.position_ned_m, (north, east, down), until_ns),
        height_above_home_m=_moved(telemetry.height_above_home_m, (-down,), until_ns),
    )


def _three(reading: Reading) -> tuple[float, float, float]:
    x, y, z = reading.values
    return x, y, z


def _moved(reading: Reading | None, by: tuple[float, ...], at_ns: int) -> Reading | None:
    if reading is None:
        return None
    return Reading(at_ns, tuple(a + b for a, b in zip(reading.values, by, strict=True)))
