"""Ticks in, percentiles out: what a flight's report says of its timing. Pure, constant memory."""

import json
from dataclasses import asdict, dataclass
from typing import Literal

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.histogram import Histogram
from mavbridge.core.records import Event, LinkStats, Percentiles, Tick, VisionTick

MAX_RELEASES = 1000
"""Release transitions kept in a report; the rest is counted."""


Mode = Literal["dual", "single"]


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionReport:
    """The action loop while the policy flew; None = not measured."""

    target_hz: float
    rate_hz: float | None
    flying_s: float
    """How long that was; the rest of the flight is waiting, preparing and releases."""
    ticks: int
    missed_slots: int
    period_ms: Percentiles | None
    """Wake to wake."""
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
    """By the source, since the first frame of the flight."""
    encode_ms: Percentiles | None


@dataclass(frozen=True, slots=True, kw_only=True)
class ReleaseEvent:
    """The sticks went back to the pilot, or the reason why they stay there changed."""

    t_s: float
    """Since the first tick."""
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserverDrops:
    """Events that observers missed; None = not running."""

    rerun: int | None
    recorder: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class TimingReport:
    """What a flight was like; None = not measured."""

    duration_s: float
    mode: Mode
    engine: str
    policy: str
    autopilot: str | None
    action: ActionReport
    vision: VisionReport
    feature_age_ms: Percentiles | None
    """Since exposure, at the send, of the feature behind each action."""
    state_age_ms: Percentiles | None
    """Since arrival, at the send, of the attitude behind each action."""
    state_to_wire_ms: Percentiles | None
    """Arrival of an attitude to the departure of the first sticks made from it."""
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
        self._action = _ActionCounts(action_hz)
        self._vision = _VisionCounts(vision_hz)

    def emit(self, event: Event) -> None:
        """Count the event."""
        if isinstance(event, Tick):
            self._action.add(event)
        else:
            self._vision.add(event)

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
        """All that was counted so far; exact once the loops have stopped."""
        action = self._action
        return TimingReport(
            duration_s=round(action.span.duration_s, 3),
            mode=mode,
            engine=engine,
            policy=policy,
            autopilot=autopilot,
            action=action.report(),
            vision=self._vision.report(),
            feature_age_ms=action.feature_age.percentiles_ms(),
            state_age_ms=action.state_age.percentiles_ms(),
            state_to_wire_ms=action.state_to_wire.percentiles_ms(),
            link=link,
            releases=tuple(action.releases),
            release_count=action.release_count,
            observer_drops=observer_drops,
        )


class _Span:
    """First and last of a series of stamps, and how many."""

    def __init__(self) -> None:
        self.first_ns: int | None = None
        self.last_ns: int | None = None
        self.count = 0

    def add(self, stamp_ns: int) -> int | None:
        """Time since the previous stamp; None for the first."""
        since_ns = None if self.last_ns is None else stamp_ns - self.last_ns
        if self.first_ns is None:
            self.first_ns = stamp_ns
        self.last_ns = stamp_ns
        self.count += 1
        return since_ns

    @property
    def duration_s(self) -> float:
        if self.first_ns is None or self.last_ns is None:
            return 0.0
        return (self.last_ns - self.first_ns) / NS_PER_S

    @property
    def rate_hz(self) -> float | None:
        """Intervals per second; None before there is one."""
        duration_s = self.duration_s
        return round((self.count - 1) / duration_s, 3) if duration_s > 0 else None


class _ActionCounts:
    """The action thread's half of ``FlightTiming``."""

    def __init__(self, target_hz: float) -> None:
        self._target_hz = target_hz
        self._target_period_ns = round(NS_PER_S / target_hz)
        self._missed_slots = 0
        self._flown_ticks = 0
        self._flown_ns: int | None = None
        self._flying_ns = 0
        self._period, self._jitter, self._predict = Histogram(), Histogram(), Histogram()
        self._last_reason: str | None = None
        self._last_attitude_ns: int | None = None
        self.span = _Span()
        self.feature_age, self.state_age = Histogram(), Histogram()
        self.state_to_wire = Histogram()
        self.releases: list[ReleaseEvent] = []
        self.release_count = 0

    def add(self, tick: Tick) -> None:
        self.span.add(tick.woke_ns)
        if tick.predict_ns is not None:
            self._predict.add(tick.predict_ns)
        if tick.trace is None:
            self._flown_ns = None
        else:
            self._add_period(tick)
            self._add_ages(tick)
        if tick.release_reason != self._last_reason:
            self._last_reason = tick.release_reason
            if tick.release_reason is not None:
                self._add_release(tick.woke_ns, tick.release_reason)

    def _add_period(self, tick: Tick) -> None:
        """Only between two ticks of flight: a released loop has nothing to compute."""
        self._flown_ticks += 1
        last_ns, self._flown_ns = self._flown_ns, tick.woke_ns
        if last_ns is None:
            return
        period_ns = tick.woke_ns - last_ns
        self._period.add(period_ns)
        self._jitter.add(abs(period_ns - self._target_period_ns))
        self._missed_slots += tick.missed_slots
        self._flying_ns += period_ns

    def _add_ages(self, tick: Tick) -> None:
        if tick.feature_captured_ns is not None:
            self.feature_age.add(tick.sent_ns - tick.feature_captured_ns)
        if tick.state is None:
            return
        age_ns = tick.sent_ns - tick.state.attitude_ns
        self.state_age.add(age_ns)
        if tick.sent is not None and tick.state.attitude_ns != self._last_attitude_ns:
            self._last_attitude_ns = tick.state.attitude_ns
            self.state_to_wire.add(age_ns)

    def _add_release(self, woke_ns: int, reason: str) -> None:
        self.release_count += 1
        if len(self.releases) < MAX_RELEASES and self.span.first_ns is not None:
            t_s = (woke_ns - self.span.first_ns) / NS_PER_S
            self.releases.append(ReleaseEvent(t_s=round(t_s, 3), reason=reason))

    def report(self) -> ActionReport:
        return ActionReport(
            target_hz=self._target_hz,
            rate_hz=(
                round(self._period.count * NS_PER_S / self._flying_ns, 3)
                if self._flying_ns
                else None
            ),
            flying_s=round(self._flying_ns / NS_PER_S, 3),
            ticks=self._flown_ticks,
            missed_slots=self._missed_slots,
            period_ms=self._period.percentiles_ms(),
            jitter_ms=self._jitter.percentiles_ms(),
            predict_ms=self._predict.percentiles_ms(),
        )


class _VisionCounts:
    """The vision thread's half of ``FlightTiming``."""

    def __init__(self, target_hz: float) -> None:
        self._target_hz = target_hz
        self._span = _Span()
        self._encode = Histogram()
        self._dropped_before: int | None = None
        self._dropped_frames = 0

    def add(self, vision: VisionTick) -> None:
        self._span.add(vision.started_ns)
        self._encode.add(vision.ready_ns - vision.started_ns)
        if self._dropped_before is None:
            self._dropped_before = vision.dropped_frames
        self._dropped_frames = vision.dropped_frames - self._dropped_before

    def report(self) -> VisionReport:
        return VisionReport(
            target_hz=self._target_hz,
            rate_hz=self._span.rate_hz,
            frames=self._span.count,
            dropped_frames=self._dropped_frames,
            encode_ms=self._encode.percentiles_ms(),
        )


def report_json(report: TimingReport) -> str:
    """The report as JSON, keys in the order of the dataclasses; null = not measured."""
    document = asdict(report)
    if report.link is not None:
        document["link"]["messages_per_s"] = dict(report.link.messages_per_s)
    return json.dumps(document, indent=2, allow_nan=False) + "\n"
