"""The fast path: newest state + cached feature -> chunk of actions -> one stick command a slot."""

import threading
from collections.abc import Callable
from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, Pacer, Slot
from mavbridge.core.ports import Link, TickSink
from mavbridge.core.records import FeatureFrame, FloatArray, Tick, VehicleState
from mavbridge.core.vehicle import (
    IDLE,
    NEUTRAL,
    Command,
    Decision,
    LinkSnapshot,
    Release,
    Sticks,
    StickTrace,
    VehicleStatus,
)
from mavbridge.flight.ego_motion import EgoMotion
from mavbridge.flight.feature_cache import FeatureCache
from mavbridge.flight.history import SentHistory, sample_chunk
from mavbridge.flight.state import Freshness, StateFrame, build_state
from mavbridge.gate.engagement import Engagement, Facts, Hold, Request, check_chunk
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
    """Parts of the contract and the limits that the loop needs."""

    state_frame: StateFrame
    since_exposure: bool
    """The age of the image and the motion since its exposure are appended to the state."""
    chunk_dt_s: float
    history_len: int
    history_dt_s: float
    freshness: Freshness
    max_feature_age_ns: int
    lead_s: float
    """How far ahead of the send a chunk is sampled: the lag of our own low-pass."""
    mode: str | None
    duration_ns: int | None
    """Flight time from the first engagement on; None = until stopped."""


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
        """One tick: state, feature, engagement, act, smooth, guard, send, emit."""
        snapshot, feature = self._link.poll(), self._cache.latest()
        now_ns = self._clock.now_ns()
        state = build_state(
            snapshot.telemetry,
            now_ns,
            frame=self._settings.state_frame,
            freshness=self._settings.freshness,
        )
        if isinstance(state, VehicleState) and self._ego_motion is not None:
            self._ego_motion.push(state)
        problem = self._input_problem(state, feature, now_ns)
        directive = self._engagement.step(_facts(snapshot, problem, now_ns))
        self._request(directive.request)

        trace: StickTrace | None = None
        predict_ns: int | None = None
        if isinstance(directive.sticks, Release):
            decision: Decision = directive.sticks
        elif directive.sticks is Hold.IDLE:
            decision = Command(sticks=IDLE)
        else:
            decision, trace, predict_ns = self._fly(snapshot.status, state, feature, now_ns)
        self._is_flying = trace is not None

        sent = self._link.send(decision)
        sent_ns = self._clock.now_ns()
        self._has_commanded = isinstance(decision, Command)
        self._history.append(sent, sent_ns)
        flown = (decision, trace, predict_ns)
        self._sink.emit(_tick(self._ticks, slot, snapshot, feature, state, flown, sent, sent_ns))
        self._ticks += 1
        self._link.service()
        self.alive_ns = sent_ns

    def _input_problem(
        self, state: VehicleState | Release, feature: FeatureFrame | None, now_ns: int
    ) -> str | None:
        """Name what the policy lacks at this tick, or None."""
        if isinstance(state, Release):
            return state.reason
        if feature is None:
            return "no image feature yet"
        if now_ns - feature.captured_ns > self._settings.max_feature_age_ns:
            limit_ms = self._settings.max_feature_age_ns // NS_PER_MS
            return f"the image feature is older than {limit_ms} ms"
        return None

    def _fly(
        self,
        status: VehicleStatus | None,
        state: VehicleState | Release,
        feature: FeatureFrame | None,
        now_ns: int,
    ) -> tuple[Decision, StickTrace | None, int]:
        """Sample the policy, check its chunk, and smooth the action that acts now.

        Returns the decision, the trace of its sticks (None if the chunk was refused), and the
        duration in ns.
        """
        if isinstance(state, Release) or feature is None:
            raise RuntimeError("engaged without inputs: the engagement must not allow this")
        if not self._is_flying:
            self._smoother.reset(_current_sticks(status, now_ns))
            self._chunk_state_ns = None
        started_ns = self._clock.now_ns()
        history = self._history.resample(now_ns)
        last_ns, self._chunk_state_ns = self._chunk_state_ns, state.attitude_ns
        elapsed_s = None if last_ns is None else (state.attitude_ns - last_ns) / NS_PER_S
        values = state.values[None]
        if self._ego_motion is not None:
            values = self._ego_motion.append_to(state, feature.captured_ns)
        chunk = self._act(feature.value, values, history, elapsed_s)
        done_ns = self._clock.now_ns()
        predict_ns = done_ns - started_ns
        if (refusal := check_chunk(chunk)) is not None:
            return refusal, None, predict_ns
        at_s = (done_ns - state.attitude_ns) / NS_PER_S + self._settings.lead_s
        raw = sample_chunk(chunk[0], chunk_dt_s=self._settings.chunk_dt_s, at_s=at_s)
        trace = self._smoother.step(raw, done_ns)
        return Command(sticks=trace.smoothed), trace, predict_ns

    def _request(self, request: Request | None) -> None:
        if request == "mode" and self._settings.mode is not None:
            self._link.set_mode(self._settings.mode)
        elif request == "arm":
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


def _facts(snapshot: LinkSnapshot, input_problem: str | None, now_ns: int) -> Facts:
    status = snapshot.status
    return Facts(
        now_ns=now_ns,
        link_problem=snapshot.problem,
        input_problem=input_problem,
        mode=status.mode if status else None,
        armed=status is not None and status.armed,
        is_overruled=snapshot.is_overruled,
        echo_confirmed=snapshot.echo_confirmed,
    )


def _current_sticks(status: VehicleStatus | None, now_ns: int) -> Sticks:
    """Stick positions to start from, as the vehicle reports them, so that nothing jumps."""
    if status is None or status.rc_sticks is None or status.rc_arrived_ns is None:
        return NEUTRAL
    is_fresh = now_ns - status.rc_arrived_ns <= RC_FRESH_NS
    return status.rc_sticks if is_fresh else NEUTRAL


def _tick(
    serial: int,
    slot: Slot,
    snapshot: LinkSnapshot,
    feature: FeatureFrame | None,
    state: VehicleState | Release,
    flown: tuple[Decision, StickTrace | None, int | None],
    sent: Sticks | None,
    sent_ns: int,
) -> Tick:
    status, (decision, trace, predict_ns) = snapshot.status, flown
    return Tick(
        serial=serial,
        index=slot.index,
        due_ns=slot.due_ns,
        woke_ns=slot.woke_ns,
        missed_slots=slot.missed,
        predict_ns=predict_ns,
        sent_ns=sent_ns,
        feature_frame_id=feature.frame_id if feature else None,
        feature_captured_ns=feature.captured_ns if feature else None,
        state=state if isinstance(state, VehicleState) else None,
        trace=trace,
        sent=sent,
        release_reason=decision.reason if isinstance(decision, Release) else None,
        mode=status.mode if status else None,
        armed=status is not None and status.armed,
        rc_channels_us=status.rc_channels_us if status else (),
        rc_sticks=status.rc_sticks if status else None,
        texts=snapshot.texts,
    )
