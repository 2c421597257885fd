"""Timing report of a flight: ticks in, percentiles out. Pure; constant memory."""

from dataclasses import dataclass
from typing import NamedTuple

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.histogram import Histogram
from mavbridge.core.reasons import Reason
from mavbridge.core.records import Event, FlightOutcome, RateMode, Tick
from mavbridge.core.vehicle import LinkStats, Percentiles

MAX_RELEASES = 1000
"""Releases listed in a report; further ones are only counted."""
LATE_PERIODS = 1.5
"""A chunk is late if it comes more than this many policy periods after the one before."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SticksReport:
    """Stick sends while the policy flew; None: not measured.

    A slot is one period of a fixed time grid. It is missed if nothing was sent within one period.
    """

    target_hz: float
    rate_hz: float | None
    """Rate of all sends, including those between two slots."""
    flying_s: float
    """Time under the policy, without waiting, preparing and releases."""
    sends: int
    coasting_sends: int
    """Sends from an outdated chunk, within the grace period."""
    slots: int
    """Slots of the grid in that time, including those served by a chunk's own send."""
    missed_slots: int
    lateness_ms: Percentiles | None
    """Time from a slot to its send."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionReport:
    """Flown chunks of actions; None: not measured."""

    target_hz: float
    rate_hz: float | None
    chunks: int
    late_chunks: int
    """Chunks that were finished more than ``LATE_PERIODS`` after the one before."""
    period_ms: Percentiles | None
    """Time between the ends of two computations."""
    predict_ms: Percentiles | None


@dataclass(frozen=True, slots=True, kw_only=True)
class VisionReport:
    """Vision loop over one flight; None: not measured."""

    target_hz: float
    rate_hz: float | None
    frames: int
    dropped_frames: int | None
    """Frames dropped by the source since the first frame of the flight."""
    encode_ms: Percentiles | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseEvent:
    """Release of the sticks, or a new reason for it, ``t_s`` after the first tick."""

    t_s: float
    reason: Reason


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserverDrops:
    """Events that observers missed; None: no such observer."""

    rerun: int | None = None
    recorder: int | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class TimingReport:
    """Timing of one flight; None: not measured."""

    duration_s: float
    mode: RateMode
    engine: str
    policy: str
    autopilot: str | None
    outcome: FlightOutcome | None
    """None if no policy has flown."""
    sticks: SticksReport
    action: ActionReport
    vision: VisionReport
    feature_age_ms: Percentiles | None
    """Time from the exposure of an image to the send of each action based on it."""
    state_age_ms: Percentiles | None
    """Time from the measurement of an attitude (its arrival, if the vehicle sends no stamp) to the
    send of each action based on it."""
    state_to_wire_ms: Percentiles | None
    """Time from the measurement of a new attitude, as in ``state_age_ms``, to the first send based
    on it; it includes the delay of the link."""
    link: LinkStats | None
    releases: tuple[ReleaseEvent, ...]
    """The first ``MAX_RELEASES``."""
    release_count: int
    observer_drops: ObserverDrops

    @property
    def times_ms(self) -> dict[str, Percentiles | None]:
        """Measured times by name."""
        return {
            "stick lateness": self.sticks.lateness_ms,
            "chunk period": self.action.period_ms,
            "predict": self.action.predict_ms,
            "vision encode": self.vision.encode_ms,
            "feature age at send": self.feature_age_ms,
            "attitude age at send": self.state_age_ms,
            "new attitude to wire": self.state_to_wire_ms,
            "link round trip": self.link.rtt_ms if self.link else None,
        }


_NO_OBSERVERS = ObserverDrops()


class FlightTiming:
    """``TickSink`` that measures the timing of a flight.

    Cheap enough for the loops' own threads: one thread emits ticks and another can emit vision
    ticks; the two share no state.
    """

    def __init__(self, *, stick_hz: float, action_hz: float, vision_hz: float) -> None:
        self._vision_hz = vision_hz
        self._ticks, self._frames = _Span(), _Span()
        self._sticks, self._chunks = _Sticks(stick_hz), _Chunks(action_hz)
        self._last_attitude_ns: int | None = None
        self._last_key: tuple[object, ...] | None = None
        self._releases: list[ReleaseEvent] = []
        self._release_count = 0
        self._feature_age, self._state_age = Histogram(), Histogram()
        self._state_to_wire, self._encode = Histogram(), Histogram()
        self._first_dropped: int | None = None
        self._dropped_frames = 0

    def emit(self, event: Event) -> None:
        """Count the event."""
        if isinstance(event, Tick):
            self._add_tick(event)
            return
        self._frames.add(event.started_ns)
        self._encode.add(event.ready_ns - event.started_ns)
        if self._first_dropped is None:
            self._first_dropped = event.dropped_frames
        self._dropped_frames = event.dropped_frames - self._first_dropped

    def _add_tick(self, tick: Tick) -> None:
        self._ticks.add(tick.woke_ns)
        self._sticks.add(tick)
        self._chunks.add(tick)
        if tick.trace is not None and not tick.is_refused:
            self._add_ages(tick)
        is_before = tick.phase in ("waiting", "preparing")
        reason = None if is_before else tick.release_reason
        key = None if reason is None else reason.key
        if key != self._last_key:
            self._last_key = key
            if reason is None:
                return
            self._release_count += 1
            if len(self._releases) < MAX_RELEASES:
                t_s = round((tick.woke_ns - self._ticks.first_ns) / NS_PER_S, 3)
                self._releases.append(ReleaseEvent(t_s=t_s, reason=reason))

    def _add_ages(self, tick: Tick) -> None:
        if tick.feature_captured_ns is not None:
            self._feature_age.add(tick.sent_ns - tick.feature_captured_ns)
        if tick.state is None:
            return
        age_ns = tick.sent_ns - tick.state.attitude_ns
        self._state_age.add(age_ns)
        if tick.sent is not None and tick.state.attitude_ns != self._last_attitude_ns:
            self._last_attitude_ns = tick.state.attitude_ns
            self._state_to_wire.add(age_ns)

    def report(
        self,
        *,
        mode: RateMode,
        engine: str,
        policy: str,
        autopilot: str | None = None,
        link: LinkStats | None = None,
        observer_drops: ObserverDrops = _NO_OBSERVERS,
        outcome: FlightOutcome | None = None,
    ) -> TimingReport:
        """Return the figures so far; exact once the loops have stopped."""
        return TimingReport(
            duration_s=round(self._ticks.duration_s, 3),
            mode=mode,
            engine=engine,
            policy=policy,
            autopilot=autopilot,
            outcome=outcome,
            sticks=self._sticks.report(),
            action=self._chunks.report(),
            vision=VisionReport(
                target_hz=self._vision_hz,
                rate_hz=self._frames.rate_hz,
                frames=self._frames.count,
                dropped_frames=self._dropped_frames,
                encode_ms=self._encode.percentiles_ms(),
            ),
            feature_age_ms=self._feature_age.percentiles_ms(),
            state_age_ms=self._state_age.percentiles_ms(),
            state_to_wire_ms=self._state_to_wire.percentiles_ms(),
            link=link,
            releases=tuple(self._releases),
            release_count=self._release_count,
            observer_drops=observer_drops,
        )


class _Sticks:
    """Statistics of sends during ticks of flight; a released loop has nothing to send."""

    def __init__(self, target_hz: float) -> None:
        self._target_hz = target_hz
        self._last_ns: int | None = None
        self._sends = self._coasting = self._stretches = self._missed = 0
        self._intervals = self._flying_ns = 0
        self._lateness = Histogram()

    def add(self, tick: Tick) -> None:
        if tick.trace is None:
            self._last_ns = None
            return
        is_sent = not tick.is_refused
        self._sends += is_sent
        self._coasting += is_sent and tick.is_coasting
        if is_sent and tick.is_slot:
            self._lateness.add(max(0, tick.sent_ns - tick.due_ns))
        if self._last_ns is None:
            self._stretches += 1
        else:
            self._missed += tick.missed_slots
            self._intervals += is_sent
            self._flying_ns += tick.woke_ns - self._last_ns
        self._last_ns = tick.woke_ns

    def report(self) -> SticksReport:
        return SticksReport(
            target_hz=self._target_hz,
            rate_hz=_rate_hz(self._intervals, self._flying_ns),
            flying_s=round(self._flying_ns / NS_PER_S, 3),
            sends=self._sends,
            coasting_sends=self._coasting,
            slots=self._stretches + round(self._flying_ns * self._target_hz / NS_PER_S),
            missed_slots=self._missed,
            lateness_ms=self._lateness.percentiles_ms(),
        )


class FlownChunk(NamedTuple):
    """Computation of a chunk that was flown."""

    serial: int
    started_ns: int
    computed_ns: int
    attitude_ns: int | None

    def period_ns(self, last: "FlownChunk") -> int:
        """Return the time since the one before. Chunks in between, overtaken by newer ones before
        any send, were computed in time nevertheless."""
        return (self.computed_ns - last.computed_ns) // (self.serial - last.serial)


class FlownChunks:
    """Finds each chunk by the tick that flew it first, within each stretch of flight."""

    def __init__(self) -> None:
        self._last: FlownChunk | None = None

    def add(self, tick: Tick) -> tuple[FlownChunk | None, FlownChunk | None]:
        """Return the tick's chunk if it is new, and the one before if that was computed before."""
        last, self._last = self._last, None
        if tick.trace is None or tick.chunk_serial is None or tick.chunk_computed_ns is None:
            return None, None
        newest = self._last = FlownChunk(
            serial=tick.chunk_serial,
            started_ns=tick.chunk_computed_ns - (tick.predict_ns or 0),
            computed_ns=tick.chunk_computed_ns,
            attitude_ns=None if tick.state is None else tick.state.attitude_ns,
        )
        if last is None:
            return newest, None
        if last.serial == newest.serial:
            self._last = last
            return None, None
        return newest, last if last.serial < newest.serial else None


class _Chunks:
    """Statistics of the flown chunks."""

    def __init__(self, target_hz: float) -> None:
        self._target_hz = target_hz
        self._late_ns = round(LATE_PERIODS * NS_PER_S / target_hz)
        self._flown = FlownChunks()
        self._chunks = self._late = self._intervals = self._span_ns = 0
        self._period, self._predict = Histogram(), Histogram()

    def add(self, tick: Tick) -> None:
        newest, last = self._flown.add(tick)
        if newest is None:
            return
        self._chunks += 1
        if tick.predict_ns is not None:
            self._predict.add(tick.predict_ns)
        if last is None:
            return
        self._intervals += newest.serial - last.serial
        self._span_ns += newest.computed_ns - last.computed_ns
        period_ns = newest.period_ns(last)
        self._period.add(period_ns)
        self._late += period_ns > self._late_ns

    def report(self) -> ActionReport:
        return ActionReport(
            target_hz=self._target_hz,
            rate_hz=_rate_hz(self._intervals, self._span_ns),
            chunks=self._chunks,
            late_chunks=self._late,
            period_ms=self._period.percentiles_ms(),
            predict_ms=self._predict.percentiles_ms(),
        )


def _rate_hz(count: int, span_ns: int) -> float | None:
    return round(count * NS_PER_S / span_ns, 3) if span_ns > 0 else None


class _Span:
    """First and last stamp of a series, and the number of its stamps."""

    def __init__(self) -> None:
        self.first_ns = self.last_ns = self.count = 0

    def add(self, stamp_ns: int) -> None:
        if not self.count:
            self.first_ns = stamp_ns
        self.last_ns = stamp_ns
        self.count += 1

    @property
    def duration_s(self) -> float:
        return (self.last_ns - self.first_ns) / NS_PER_S

    @property
    def rate_hz(self) -> float | None:
        return round((self.count - 1) / self.duration_s, 3) if self.duration_s > 0 else None
