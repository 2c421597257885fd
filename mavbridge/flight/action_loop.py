"""The fast path: pace, poll, state, feature, act, smooth, guard, send, emit, tend."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, Pacer, Slot
from mavbridge.core.ports import Link, TickSink
from mavbridge.core.records import (
    IDLE,
    NEUTRAL,
    Command,
    Decision,
    FeatureFrame,
    FloatArray,
    LinkSnapshot,
    Release,
    Sticks,
    StickTrace,
    Tick,
    VehicleState,
)
from mavbridge.flight.ego_motion import EgoMotion
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.history import SentHistory, sample_chunk
from mavbridge.flight.state import Freshness, StateFrame, build_state
from mavbridge.gate.engagement import Ask, Engagement, Facts, Hold, check_chunk
from mavbridge.gate.smoothing import StickSmoother

Act = Callable[[FloatArray, FloatArray, FloatArray, float | None], FloatArray]
"""(encoded image, state [1, 13 or 20], history [1, K, 4], seconds since the state of the last chunk
or None to start afresh) -> chunk [1, horizon, 4]."""

NEUTRAL_NS = 50 * NS_PER_MS
"""How long the sticks are neutral before they are given back at the end of a flight."""
NEUTRAL_SPACING_NS = 10 * NS_PER_MS
RC_FRESH_NS = NS_PER_S // 2
"""Oldest RC_CHANNELS that still tells where the sticks are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionSettings:
    """What the loop needs to know of the contract and the limits."""

    state_frame: StateFrame
    since_exposure: bool
    """Whether the policy is told the age of the image and the motion since."""
    chunk_dt_s: float
    history_len: int
    history_dt_s: float
    freshness: Freshness
    max_feature_age_ns: int
    lead_s: float
    """How far ahead of the send a chunk is sampled: the lag of our own low-pass."""
    mode: str | None
    duration_ns: int | None
    """Time to fly once engaged; None = until stopped."""


@dataclass(slots=True)
class _Step:
    """What one tick has gathered on its way."""

    now_ns: int
    snapshot: LinkSnapshot
    feature: FeatureFrame | None
    state: VehicleState | None = None
    trace: StickTrace | None = None
    predict_ns: int | None = None


class ActionLoop:
    """Runs in one thread, which alone uses the link."""

    def __init__(
        self,
        *,
        clock: Clock,
        link: Link,
        cache: FeatureCache,
        act: Act,
        smoother: StickSmoother,
        engagement: Engagement,
        sink: TickSink,
        settings: ActionSettings,
        pacer: Pacer,
    ) -> None:
        self._clock = clock
        self._pacer = pacer
        self._link = link
        self._cache = cache
        self._act = act
        self._smoother = smoother
        self._engagement = engagement
        self._sink = sink
        self._settings = settings
        self._history = SentHistory(length=settings.history_len, dt_s=settings.history_dt_s)
        self._ego_motion: EgoMotion | None = None
        if settings.since_exposure:
            self._ego_motion = EgoMotion(span_ns=settings.max_feature_age_ns)
        self._is_flying = False
        self._has_commanded = False
        self._ticks = 0
        self._chunk_state_ns: int | None = None
        self.alive_ns = clock.now_ns()
        """When the last tick ended; read by the watchdog of another thread."""

    def run(self, stop: threading.Event) -> None:
        """Fly until told to stop or the duration is over; the sticks go back in every case."""
        try:
            while not stop.is_set() and not self._is_over():
                self.step(self._pacer.wait())
        finally:
            self._hand_back()

    def step(self, slot: Slot) -> None:
        """One tick."""
        snapshot, feature = self._link.poll(), self._cache.latest()
        step = _Step(now_ns=self._clock.now_ns(), snapshot=snapshot, feature=feature)
        decision = self._decide(step)
        sent = self._link.send(decision)
        sent_ns = self._clock.now_ns()
        self._has_commanded = isinstance(decision, Command)
        self._history.append(sent, sent_ns)
        self._sink.emit(_tick(self._ticks, slot, step, decision, sent, sent_ns))
        self._ticks += 1
        self._link.service()
        self.alive_ns = sent_ns

    def _decide(self, step: _Step) -> Decision:
        state = build_state(
            step.snapshot.telemetry,
            step.now_ns,
            frame=self._settings.state_frame,
            freshness=self._settings.freshness,
        )
        step.state = state if isinstance(state, VehicleState) else None
        if step.state is not None and self._ego_motion is not None:
            self._ego_motion.push(step.state)
        problem = state if isinstance(state, Release) else self._feature_problem(step)
        directive = self._engagement.step(_facts(step, problem))
        self._ask(directive.ask)
        was_flying, self._is_flying = self._is_flying, directive.sticks is Hold.FLY
        if directive.sticks is Hold.IDLE:
            return Command(sticks=IDLE)
        if isinstance(directive.sticks, Release):
            return directive.sticks
        if not was_flying:
            self._smoother.reset(_current_sticks(step))
            self._chunk_state_ns = None
        return self._fly(step)

    def _feature_problem(self, step: _Step) -> Release | None:
        if step.feature is None:
            return Release("no image feature yet")
        if step.feature.age_ns(step.now_ns) > self._settings.max_feature_age_ns:
            limit_ms = self._settings.max_feature_age_ns // NS_PER_MS
            return Release(f"the image feature is older than {limit_ms} ms")
        return None

    def _fly(self, step: _Step) -> Decision:
        if step.feature is None or step.state is None:
            raise RuntimeError("engaged without inputs: the engagement must not allow this")
        started_ns = self._clock.now_ns()
        history = self._history.resample(step.now_ns)
        elapsed_s = self._elapsed_s(step.state)
        state = step.state.values[None]
        if self._ego_motion is not None:
            state = self._ego_motion.append_to(step.state, step.feature.captured_ns)
        chunk = self._act(step.feature.value, state, history, elapsed_s)
        done_ns = self._clock.now_ns()
        step.predict_ns = done_ns - started_ns
        if (refusal := check_chunk(chunk)) is not None:
            self._is_flying = False
            return refusal
        at_s = (done_ns - step.state.attitude_ns) / NS_PER_S + self._settings.lead_s
        raw = sample_chunk(chunk[0], chunk_dt_s=self._settings.chunk_dt_s, at_s=at_s)
        step.trace = self._smoother.step(raw, done_ns)
        return Command(sticks=step.trace.smoothed)

    def _elapsed_s(self, state: VehicleState) -> float | None:
        """Time from the state of the last chunk to this one, which becomes the last."""
        last_ns, self._chunk_state_ns = self._chunk_state_ns, state.attitude_ns
        return None if last_ns is None else (state.attitude_ns - last_ns) / NS_PER_S

    def _ask(self, ask: Ask | None) -> None:
        if ask == "mode" and self._settings.mode is not None:
            self._link.set_mode(self._settings.mode)
        elif ask == "arm":
            self._link.arm()

    def _is_over(self) -> bool:
        engaged_ns, duration_ns = self._engagement.engaged_ns, self._settings.duration_ns
        if engaged_ns is None or duration_ns is None:
            return False
        return self._clock.now_ns() - engaged_ns >= duration_ns

    def _hand_back(self) -> None:
        """Neutral, if we held the sticks, then release."""
        self.alive_ns = self._clock.now_ns()
        until_ns = self.alive_ns + NEUTRAL_NS
        while self._has_commanded and self.alive_ns < until_ns:
            self._link.send(Command(sticks=NEUTRAL))
            self._clock.sleep_until_ns(self.alive_ns + NEUTRAL_SPACING_NS)
            self.alive_ns = self._clock.now_ns()
        self._link.send(Release("the flight is over"))
        self._link.hand_back()


def _facts(step: _Step, problem: Release | None) -> Facts:
    status = step.snapshot.status
    return Facts(
        now_ns=step.now_ns,
        link_problem=step.snapshot.problem,
        input_problem=None if problem is None else problem.reason,
        mode=status.mode if status else None,
        armed=status is not None and status.armed,
        is_overruled=step.snapshot.is_overruled,
        echo_confirmed=step.snapshot.echo_confirmed,
    )


def _current_sticks(step: _Step) -> Sticks:
    """Where the sticks are as the policy takes over, so that it starts without a jump."""
    status = step.snapshot.status
    if status is None or status.rc_sticks is None or status.rc_arrived_ns is None:
        return NEUTRAL
    is_fresh = step.now_ns - status.rc_arrived_ns <= RC_FRESH_NS
    return status.rc_sticks if is_fresh else NEUTRAL


def _tick(
    serial: int, slot: Slot, step: _Step, decision: Decision, sent: Sticks | None, sent_ns: int
) -> Tick:
    status = step.snapshot.status
    return Tick(
        serial=serial,
        index=slot.index,
        due_ns=slot.due_ns,
        woke_ns=slot.woke_ns,
        missed_slots=slot.missed,
        predict_ns=step.predict_ns,
        sent_ns=sent_ns,
        feature_frame_id=step.feature.frame_id if step.feature else None,
        feature_captured_ns=step.feature.captured_ns if step.feature else None,
        state=step.state,
        trace=step.trace,
        sent=sent,
        release_reason=decision.reason if isinstance(decision, Release) else None,
        mode=status.mode if status else None,
        armed=status is not None and status.armed,
        rc_channels_us=status.rc_channels_us if status else (),
        rc_sticks=status.rc_sticks if status else None,
        texts=step.snapshot.texts,
    )
