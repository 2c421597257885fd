"""Ticks in, percentiles out: the timing report of a flight. Pure, constant memory."""

import json
from dataclasses import asdict, dataclass
from typing import Literal

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.histogram import Histogram
from mavbridge.core.records import Event, Tick
from mavbridge.core.vehicle import LinkStats, Percentiles

MAX_RELEASES = 1000
"""Releases listed in a report; the rest are only counted."""

Mode = Literal["dual", "single"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionReport:
    """The action loop while the policy flew; None = not measured.

    A slot is one period of the loop's fixed time grid. The loop runs once in each slot; a slot that
    it was too late for is missed.
    """

    target_hz: float
    rate_hz: float | None
    flying_s: float
    """Duration of this part; the rest of the flight is waiting, preparing and releases."""
    ticks: int
    missed_slots: int
    period_ms: Percentiles | None
    jitter_ms: Percentiles | None
    """|period - target period|; a stall of n slots shows as one jitter of n periods."""
    predict_ms: Percentiles | None


@dataclass(frozen=True, slots=True, kw_only=True)
class VisionReport:
    """The vision loop over one flight; None = not measured."""

    target_hz: float
    rate_hz: float | None
    frames: int
    dropped_frames: int
    """Dropped by the source since the first frame of the flight."""
    encode_ms: Percentiles | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseEvent:
    """A release of the sticks, or a new reason for it, ``t_s`` after the first tick."""

    t_s: float
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserverDrops:
    """Events that observers missed; None = no such observer."""

    rerun: int | None
    recorder: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TimingReport:
    """Timing of one flight; None = not measured."""

    duration_s: float
    mode: Mode
    engine: str
    policy: str
    autopilot: str | None
    action: ActionReport
    vision: VisionReport
    feature_age_ms: Percentiles | None
    """Time from the exposure of an image to the sending of each action that is based on it."""
    state_age_ms: Percentiles | None
    """Time from the arrival of an attitude to the sending of each action that is based on it."""
    state_to_wire_ms: Percentiles | None
    """State to wire: time from the arrival of a new attitude to the sending of the first sticks
    that are based on it."""
    link: LinkStats | None
    releases: tuple[ReleaseEvent, ...]
    """The first ``MAX_RELEASES``."""
    release_count: int
    observer_drops: ObserverDrops


class FlightTiming:
    """A ``TickSink`` that counts a flight.

    Cheap enough for the loops' own threads: one thread emits ticks, another may emit vision ticks,
    and they share nothing.
    """

    def __init__(self, *, action_hz: float, vision_hz: float) -> None:
        self._action_hz, self._vision_hz = action_hz, vision_hz
        self._ticks, self._frames = _Span(), _Span()
        self._flown_ticks = self._missed_slots = self._flying_ns = 0
        self._last_flown_ns: int | None = None
        self._last_attitude_ns: int | None = None
        self._last_reason: str | None = None
        self._releases: list[ReleaseEvent] = []
        self._release_count = 0
        self._period, self._jitter, self._predict = Histogram(), Histogram(), Histogram()
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
        if tick.predict_ns is not None:
            self._predict.add(tick.predict_ns)
        if tick.trace is None:
            self._last_flown_ns = None
        else:
            self._add_period(tick)
            self._add_ages(tick)
        if tick.release_reason != self._last_reason:
            self._last_reason = tick.release_reason
            if tick.release_reason is None:
                return
            self._release_count += 1
            if len(self._releases) < MAX_RELEASES:
                t_s = round((tick.woke_ns - self._ticks.first_ns) / NS_PER_S, 3)
                self._releases.append(ReleaseEvent(t_s=t_s, reason=tick.release_reason))

    def _add_period(self, tick: Tick) -> None:
        """Only between two ticks of flight: a released loop has nothing to compute."""
        self._flown_ticks += 1
        last_ns, self._last_flown_ns = self._last_flown_ns, tick.woke_ns
        if last_ns is None:
            return
        period_ns = tick.woke_ns - last_ns
        self._period.add(period_ns)
        self._jitter.add(abs(period_ns - round(NS_PER_S / self._action_hz)))
        self._missed_slots += tick.missed_slots
        self._flying_ns += period_ns

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
        mode: Mode,
        engine: str,
        policy: str,
        autopilot: str | None,
        link: LinkStats | None,
        observer_drops: ObserverDrops,
    ) -> TimingReport:
        """The figures so far; exact once the loops have stopped."""
        intervals = self._period.count
        return TimingReport(
            duration_s=round(self._ticks.duration_s, 3),
            mode=mode,
            engine=engine,
            policy=policy,
            autopilot=autopilot,
            action=ActionReport(
                target_hz=self._action_hz,
                rate_hz=round(intervals * NS_PER_S / self._flying_ns, 3) if intervals else None,
                flying_s=round(self._flying_ns / NS_PER_S, 3),
                ticks=self._flown_ticks,
                missed_slots=self._missed_slots,
                period_ms=self._period.percentiles_ms(),
                jitter_ms=self._jitter.percentiles_ms(),
                predict_ms=self._predict.percentiles_ms(),
            ),
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


class _Span:
    """First and last of a series of stamps, and their number."""

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


def report_json(report: TimingReport) -> str:
    """The report as JSON, keys in the order of the dataclasses; null = not measured."""
    document = asdict(report)
    if report.link is not None:
        document["link"]["messages_per_s"] = dict(report.link.messages_per_s)
    return json.dumps(document, indent=2, allow_nan=False) + "\n"
