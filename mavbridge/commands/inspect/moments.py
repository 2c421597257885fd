"""Worst moments of a recorded flight, and their descriptions."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise

from mavbridge.commands.inspect.delays import DelayEvent
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Kind
from mavbridge.core.records import Tick
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.recording.crash import CrashWatch
from mavbridge.recording.flight_folder import RecordedFlight
from mavbridge.recording.rows import FrameRow

MOMENTS = 10
APART_S = 0.25
"""Moments closer together than this are merged into one."""
CRASH_MS, END_MS = 20_000.0, 10_000.0
"""Weights of a crash and of an unplanned end: worse than any delay."""
IMAGE_PERIODS = 2.0
"""Gap between two exposures, in periods, above which it is reported."""
LEAST_MS = 1.0
"""Coasting that ends sooner, with a chunk between two slots, is not reported."""


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Moment worth a user's attention."""

    t_s: float
    """Time since the first tick."""
    what: str
    severity_ms: float
    """Length of the delay, age or gap; sort key of the moments."""
    detail: str
    """Figures and cause, as a phrase."""


def worst_moments(
    flight: RecordedFlight,
    ticks: Sequence[Tick],
    frames: Sequence[FrameRow],
    delays: Sequence[DelayEvent],
    limits: FreshnessLimits | None = None,
) -> tuple[Moment, ...]:
    """Return the ``MOMENTS`` worst, at least ``APART_S`` apart, starting with the worst.

    ``limits`` are the age limits of the flown chunks; None: unknown.
    """
    if not ticks:
        return ()
    start_ns = ticks[0].woke_ns
    found = [
        *_crash(flight, ticks),
        *_ends(ticks, start_ns),
        *_delay_moments(delays, start_ns),
        *_coasting(ticks, limits),
        *_old_images(ticks, start_ns),
        *_image_gaps(flight, frames, ticks),
        *_rows_lost(flight, start_ns),
    ]
    groups: list[list[Moment]] = []
    for moment in sorted(found, key=lambda moment: -moment.severity_ms):
        near = [group for group in groups if abs(moment.t_s - group[0].t_s) < APART_S]
        if not near:
            groups.append([moment])
        elif all(moment.what != other.what for other in near[0]):
            near[0].append(moment)
    return tuple(_told_together(group) for group in groups[:MOMENTS])


def _told_together(group: Sequence[Moment]) -> Moment:
    """Merge close moments: the worst one, with the worst of each other kind in its detail."""
    worst, *others = group
    phrases = [worst.detail, *(f"{other.what}: {other.detail}" for other in others)]
    return replace(worst, detail="; ".join(phrases))


def _since_s(at_ns: int, start_ns: int) -> float:
    return (at_ns - start_ns) / NS_PER_S


def _crash(flight: RecordedFlight, ticks: Sequence[Tick]) -> Iterator[Moment]:
    """Yield the first crash in the ticks. The meta of a recording that was cut off cannot report
    one, so its ticks are searched, too."""
    if flight.meta.finished and flight.meta.crash is None:
        return
    watch = CrashWatch()
    for tick in ticks:
        watch.see(tick)
        if watch.reason is not None:
            yield Moment(
                t_s=_since_s(tick.woke_ns, ticks[0].woke_ns),
                what="crash",
                severity_ms=CRASH_MS,
                detail=watch.reason,
            )
            return


def _ends(ticks: Sequence[Tick], start_ns: int) -> Iterator[Moment]:
    for last, tick in pairwise(ticks):
        reason = tick.release_reason
        is_asked = reason is not None and (reason.kind is Kind.END or reason.code is Code.OPERATOR)
        is_planned = is_asked or (tick.phase == "ended" and reason is None)
        if last.trace is None or tick.trace is not None or is_planned:
            continue
        yield Moment(
            t_s=_since_s(tick.woke_ns, start_ns),
            what="the policy's flight ended",
            severity_ms=END_MS,
            detail=f"{reason or 'no reason was recorded'}{_ages(last)}",
        )


def _ages(tick: Tick) -> str:
    """Return the ages of the data behind a tick's sticks, as the end of a phrase."""
    parts = []
    if tick.state is not None:
        age_ms = (tick.sent_ns - tick.state.attitude_ns) / NS_PER_MS
        parts.append(f"an attitude of {age_ms:.0f} ms ago")
    if tick.feature_captured_ns is not None:
        age_ms = (tick.sent_ns - tick.feature_captured_ns) / NS_PER_MS
        parts.append(f"an image of {age_ms:.0f} ms ago")
    return f"; its last sticks were by {' and '.join(parts)}" if parts else ""


def _delay_moments(delays: Sequence[DelayEvent], start_ns: int) -> Iterator[Moment]:
    for delay in delays:
        what = "late chunk"
        if delay.what == "missed slots":
            what = f"{delay.count} missed slot{'' if delay.count == 1 else 's'}"
        yield Moment(
            t_s=_since_s(delay.at_ns, start_ns),
            what=what,
            severity_ms=delay.delay_ms,
            detail=f"{delay.delay_ms:.1f} ms late: {delay.cause}",
        )


def _coasting(ticks: Sequence[Tick], limits: FreshnessLimits | None) -> Iterator[Moment]:
    """Yield sends of an outdated chunk, up to the first send of a fresh one."""
    at = 0
    for is_coasting, group in groupby(ticks, lambda tick: tick.is_coasting and bool(tick.trace)):
        run = list(group)
        at += len(run)
        if not is_coasting:
            continue
        end_ns = ticks[at].woke_ns if at < len(ticks) else run[-1].sent_ns
        lasted_ms = (end_ns - run[0].woke_ns) / NS_PER_MS
        if lasted_ms < LEAST_MS:
            continue
        yield Moment(
            t_s=_since_s(run[0].woke_ns, ticks[0].woke_ns),
            what="coasting",
            severity_ms=lasted_ms,
            detail=f"for {lasted_ms:.0f} ms along an old chunk: {_staleness(run[0], limits)}",
        )


def _staleness(tick: Tick, limits: FreshnessLimits | None) -> str:
    """Return why the chunk of a tick was outdated; in the order of the guard's own check."""
    state = tick.state
    if limits is not None and state is not None:
        ages = (
            ("attitude", state.attitude_ns, limits.state_ns),
            ("velocity", state.velocity_ns, limits.velocity_ns),
            ("image", tick.feature_captured_ns, limits.feature_ns),
            ("chunk", tick.chunk_computed_ns, limits.chunk_ns),
        )
        decided_ns = tick.sent_ns if tick.decided_ns is None else tick.decided_ns
        for name, happened_ns, limit_ns in ages:
            if happened_ns is not None and decided_ns - happened_ns > limit_ns:
                age_ms = (decided_ns - happened_ns) / NS_PER_MS
                return f"its {name} was {age_ms:.0f} ms old, beyond {limit_ns / NS_PER_MS:.0f} ms"
    return "no newer one came in time"


def _old_images(ticks: Sequence[Tick], start_ns: int) -> Iterator[Moment]:
    """Yield the oldest image of each stretch of sticks based on images twice as old as usual."""
    aged = [
        (tick.sent_ns - tick.feature_captured_ns, tick)
        for tick in ticks
        if tick.trace is not None and tick.feature_captured_ns is not None
    ]
    if not aged:
        return
    usual_ns = sorted(age_ns for age_ns, _ in aged)[len(aged) // 2]
    for is_old, group in groupby(aged, lambda pair: pair[0] > 2 * usual_ns):
        if is_old:
            age_ns, tick = max(group, key=lambda pair: pair[0])
            yield Moment(
                t_s=_since_s(tick.woke_ns, start_ns),
                what="old image",
                severity_ms=(age_ns - usual_ns) / NS_PER_MS,
                detail=f"sticks by an image of {age_ns / NS_PER_MS:.0f} ms ago",
            )


def _image_gaps(
    flight: RecordedFlight, frames: Sequence[FrameRow], ticks: Sequence[Tick]
) -> Iterator[Moment]:
    """Yield gaps between exposures from the first tick to the last, except the recorder's."""
    period_ms = 1000 / flight.meta.visual_hz
    for last, frame in pairwise(frames):
        gap_ms = (frame.captured_ns - last.captured_ns) / NS_PER_MS
        is_in_flight = ticks[0].woke_ns <= frame.captured_ns <= ticks[-1].woke_ns
        if gap_ms > IMAGE_PERIODS * period_ms and is_in_flight and not frame.dropped_before:
            yield Moment(
                t_s=_since_s(frame.captured_ns, ticks[0].woke_ns),
                what="gap between images",
                severity_ms=gap_ms - period_ms,
                detail=f"{gap_ms:.0f} ms without an exposure that was used",
            )


def _rows_lost(flight: RecordedFlight, start_ns: int) -> Iterator[Moment]:
    dropped = flight.ticks.column("dropped_before").to_pylist()
    woke_ns = flight.ticks.column("woke_ns").to_pylist()
    for count, at_ns in zip(dropped, woke_ns, strict=True):
        if count:
            lost_ms = 1000 * count / flight.meta.action_hz
            yield Moment(
                t_s=_since_s(at_ns, start_ns),
                what="rows lost",
                severity_ms=lost_ms,
                detail=f"{count} ticks before this are not in the recording: the recorder fell "
                "behind",
            )
