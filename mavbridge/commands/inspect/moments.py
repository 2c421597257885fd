"""What went wrong in a recorded flight, when, and why."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Tick
from mavbridge.observe.timing import LATE_PERIODS
from mavbridge.recording.flight_folder import RecordedFlight
from mavbridge.recording.rows import FrameRow

Cause = Literal[
    "the gate woke late",
    "sending took long",
    "the policy took long",
    "the attitude came late",
    "the policy loop began late",
]
MOMENTS = 10
APART_S = 0.25
"""Of moments that are closer together, the worst one is told."""
RELEASE_MS = 10_000.0
"""Weight of a release that nobody asked for: worse than any delay."""
IMAGE_PERIODS = 2.0
"""A gap between two exposures beyond this many periods is worth telling."""


@dataclass(frozen=True, kw_only=True)
class Delay:
    """A late chunk, or missed slots in a row."""

    at_ns: int
    what: Literal["late chunk", "missed slots"]
    count: int
    """Slots that were missed; 1 for a chunk."""
    delay_ms: float
    """Time beyond the period."""
    cause: Cause


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Something that a person wants to look at."""

    t_s: float
    """Since the first tick."""
    what: str
    severity_ms: float
    """Length of the delay, age or gap, by which moments are put in order."""
    detail: str
    """Figures and cause, as a phrase."""


def find_delays(ticks: Sequence[Tick], *, stick_hz: float, action_hz: float) -> tuple[Delay, ...]:
    """Missed slots and late chunks while the policy flew, in the order of time."""
    slot_ns, chunk_ns = NS_PER_S / stick_hz, NS_PER_S / action_hz
    found = [*_missed_slots(ticks, slot_ns), *_late_chunks(ticks, chunk_ns)]
    return tuple(sorted(found, key=lambda delay: delay.at_ns))


def _missed_slots(ticks: Sequence[Tick], slot_ns: float) -> Iterator[Delay]:
    for last, tick in pairwise(ticks):
        if last.trace is None or tick.trace is None or not tick.missed_slots:
            continue
        is_slow_send = last.sent_ns - last.woke_ns > slot_ns / 2
        yield Delay(
            at_ns=tick.woke_ns,
            what="missed slots",
            count=tick.missed_slots,
            delay_ms=max(0.0, tick.sent_ns - last.sent_ns - slot_ns) / NS_PER_MS,
            cause="sending took long" if is_slow_send else "the gate woke late",
        )


def _late_chunks(ticks: Sequence[Tick], chunk_ns: float) -> Iterator[Delay]:
    last: Tick | None = None
    for tick in ticks:
        if tick.trace is None or tick.chunk_serial is None or tick.chunk_computed_ns is None:
            last = None
            continue
        if last is not None and last.chunk_serial == tick.chunk_serial:
            continue
        if last is not None and (delay := _late_chunk(last, tick, chunk_ns)) is not None:
            yield delay
        last = tick


def _late_chunk(last: Tick, tick: Tick, chunk_ns: float) -> Delay | None:
    """A chunk beyond ``LATE_PERIODS`` after the one before, and the first stage that was late."""
    if None in (last.chunk_serial, tick.chunk_serial, last.chunk_computed_ns):
        return None
    count = (tick.chunk_serial or 0) - (last.chunk_serial or 0)
    period_ns = (tick.chunk_computed_ns or 0) - (last.chunk_computed_ns or 0)
    if count < 1 or period_ns / count <= LATE_PERIODS * chunk_ns:
        return None
    cause: Cause = "the policy loop began late"
    if (tick.predict_ns or 0) > chunk_ns:
        cause = "the policy took long"
    elif last.state is not None and tick.state is not None:
        apart_ns = tick.state.attitude_ns - last.state.attitude_ns
        if apart_ns / count > LATE_PERIODS * chunk_ns:
            cause = "the attitude came late"
    return Delay(
        at_ns=tick.woke_ns,
        what="late chunk",
        count=1,
        delay_ms=(period_ns / count - chunk_ns) / NS_PER_MS,
        cause=cause,
    )


def worst_moments(
    flight: RecordedFlight,
    ticks: Sequence[Tick],
    frames: Sequence[FrameRow],
    delays: Sequence[Delay],
) -> tuple[Moment, ...]:
    """The ``MOMENTS`` worst, at least ``APART_S`` apart, the worst one first."""
    if not ticks:
        return ()
    start_ns = ticks[0].woke_ns
    found = [
        *_releases(ticks, start_ns),
        *_delay_moments(delays, start_ns),
        *_coasting(ticks, start_ns),
        *_oldest_image(ticks, start_ns),
        *_image_gaps(flight, frames, ticks),
        *_rows_lost(flight, start_ns),
    ]
    chosen: list[Moment] = []
    for moment in sorted(found, key=lambda moment: -moment.severity_ms):
        if all(abs(moment.t_s - other.t_s) >= APART_S for other in chosen):
            chosen.append(moment)
    return tuple(chosen[:MOMENTS])


def _since_s(at_ns: int, start_ns: int) -> float:
    return (at_ns - start_ns) / NS_PER_S


def _releases(ticks: Sequence[Tick], start_ns: int) -> Iterator[Moment]:
    for last, tick in pairwise(ticks):
        if last.trace is not None and tick.trace is None:
            yield Moment(
                t_s=_since_s(tick.woke_ns, start_ns),
                what="the policy's flight ended",
                severity_ms=RELEASE_MS,
                detail=tick.release_reason or "no reason was recorded",
            )


def _delay_moments(delays: Sequence[Delay], start_ns: int) -> Iterator[Moment]:
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


def _coasting(ticks: Sequence[Tick], start_ns: int) -> Iterator[Moment]:
    began: Tick | None = None
    for tick in ticks:
        if tick.is_coasting and tick.trace is not None:
            began = began or tick
        elif began is not None:
            lasted_ms = (tick.woke_ns - began.woke_ns) / NS_PER_MS
            yield Moment(
                t_s=_since_s(began.woke_ns, start_ns),
                what="coasting",
                severity_ms=lasted_ms,
                detail=f"for {lasted_ms:.0f} ms no chunk came that could be flown",
            )
            began = None


def _oldest_image(ticks: Sequence[Tick], start_ns: int) -> Iterator[Moment]:
    """The sticks with the oldest image, where it is twice as old as usual."""
    ages = [
        (tick.sent_ns - tick.feature_captured_ns, tick)
        for tick in ticks
        if tick.trace is not None and tick.feature_captured_ns is not None
    ]
    if not ages:
        return
    usual_ns = sorted(age_ns for age_ns, _ in ages)[len(ages) // 2]
    age_ns, tick = max(ages, key=lambda pair: pair[0])
    if age_ns > 2 * usual_ns:
        yield Moment(
            t_s=_since_s(tick.woke_ns, start_ns),
            what="old image",
            severity_ms=(age_ns - usual_ns) / NS_PER_MS,
            detail=f"sticks by an image of {age_ns / NS_PER_MS:.0f} ms ago",
        )


def _image_gaps(
    flight: RecordedFlight, frames: Sequence[FrameRow], ticks: Sequence[Tick]
) -> Iterator[Moment]:
    """Gaps between exposures from the first tick to the last."""
    period_ms = 1000 / flight.meta.visual_hz
    for last, frame in pairwise(frames):
        gap_ms = (frame.captured_ns - last.captured_ns) / NS_PER_MS
        is_in_flight = ticks[0].woke_ns <= frame.captured_ns <= ticks[-1].woke_ns
        if gap_ms > IMAGE_PERIODS * period_ms and is_in_flight:
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
                detail=f"{count} ticks before this are not in the recording: the disk was slow",
            )
