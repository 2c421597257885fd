"""Missed slots and late chunks of a recorded flight with their causes, and its worst moments."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Kind, Reason
from mavbridge.core.records import FlightOutcome, Tick
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.observe.timing import LATE_PERIODS, FlownChunk, FlownChunks
from mavbridge.recording.crash import CrashWatch
from mavbridge.recording.flight_folder import RecordedFlight
from mavbridge.recording.folder import FlightMeta

Stamps: TypeAlias = NDArray[np.int64]
Cause = Literal[
    "the guard woke late",
    "sending took long",
    "the link refused the command",
    "the policy took long",
    "the attitude came late",
    "the policy loop began late",
    "the attitude or the policy loop was late",
]
"""The last cause covers recordings without arrivals, which would tell its two cases apart."""
MOMENTS = 10
APART_S = 0.25
"""Moments closer together than this are merged into one."""
CRASH_MS, END_MS = 20_000.0, 10_000.0
"""Weights of a crash and of an unplanned end: worse than any delay."""
IMAGE_PERIODS = 2.0
"""Gap between two exposures, in periods, above which it is reported."""
LEAST_MS = 1.0
"""Coasting that ends sooner, with a chunk between two slots, is not reported."""


class Arrivals(NamedTuple):
    """Attitudes of the vehicle in the order of measurement."""

    happened_ns: Stamps
    """[K] measurement times, as in ``VehicleState.attitude_ns``."""
    arrived_ns: Stamps
    """[K] arrivals at this computer."""


@dataclass(frozen=True)
class Moment:
    """Moment worth a user's attention."""

    t_s: float
    """Time since the first tick."""
    what: str
    severity_ms: float
    """Length of the delay, age or gap; sort key of the moments."""
    detail: str
    """Figures and cause, as a phrase."""
    cause: Cause | None = None
    """Of a late chunk or of consecutive missed slots."""
    count: int = 1
    """Number of missed slots; 1 for anything else."""


def _delay(t_s: float, what: str, delay_ms: float, cause: Cause, count: int = 1) -> Moment:
    return Moment(t_s, what, delay_ms, f"{delay_ms:.1f} ms late: {cause}", cause, count)


def is_gap(last: Tick, tick: Tick) -> bool:
    """True if the recording lacks ticks between these two neighbours."""
    return tick.serial != last.serial + 1


def find_delays(
    ticks: Sequence[Tick], *, stick_hz: float, action_hz: float, arrivals: Arrivals | None = None
) -> tuple[Moment, ...]:
    """Return missed slots and late chunks while the policy flew, in the order of time.

    Gaps in which the recorder lost ticks are left out.
    """
    slot_ns, chunk_ns = NS_PER_S / stick_hz, NS_PER_S / action_hz
    found = [*_missed_slots(ticks, slot_ns), *_late_chunks(ticks, chunk_ns, arrivals)]
    return tuple(sorted(found, key=lambda delay: delay.t_s))


def _t_s(ticks: Sequence[Tick], at_ns: int) -> float:
    return (at_ns - ticks[0].woke_ns) / NS_PER_S


def _missed_slots(ticks: Sequence[Tick], slot_ns: float) -> Iterator[Moment]:
    for last, tick in pairwise(ticks):
        is_flown = last.trace is not None and tick.trace is not None
        if is_flown and tick.missed_slots and not is_gap(last, tick):
            due_ns = last.due_ns if last.is_refused else last.sent_ns + slot_ns
            delay_ms = max(0.0, tick.sent_ns - due_ns) / NS_PER_MS
            is_slow_send = last.sent_ns - last.woke_ns > slot_ns / 2
            cause: Cause = "sending took long" if is_slow_send else "the guard woke late"
            if last.is_refused:
                cause = "the link refused the command"
            count = tick.missed_slots
            what = f"{count} missed slot{'' if count == 1 else 's'}"
            yield _delay(_t_s(ticks, tick.woke_ns), what, delay_ms, cause, count)


def _late_chunks(
    ticks: Sequence[Tick], chunk_ns: float, arrivals: Arrivals | None
) -> Iterator[Moment]:
    """Yield chunks that came more than ``LATE_PERIODS`` after the one before."""
    chunks = FlownChunks()
    for before, tick in zip([None, *ticks], ticks, strict=False):
        if before is not None and is_gap(before, tick):
            chunks = FlownChunks()
        solve, last = chunks.add(tick)
        if solve is None or last is None:
            continue
        if (period_ns := solve.period_ns(last)) > LATE_PERIODS * chunk_ns:
            delay_ms = (period_ns - chunk_ns) / NS_PER_MS
            cause = _cause(last, solve, chunk_ns, arrivals)
            yield _delay(_t_s(ticks, tick.woke_ns), "late chunk", delay_ms, cause)


def _cause(
    last: FlownChunk, solve: FlownChunk, chunk_ns: float, arrivals: Arrivals | None
) -> Cause:
    """Return the stage that caused most of the delay.

    A solve can start one period after the last one, once that has ended and an attitude is new.
    """
    due_ns = last.started_ns + (solve.serial - last.serial) * chunk_ns
    free_ns = max(due_ns, last.computed_ns)
    longer_ns = (solve.computed_ns - solve.started_ns) - (last.computed_ns - last.started_ns)
    solving_ns = max(0, longer_ns) + free_ns - due_ns
    waiting_ns = max(0.0, solve.started_ns - free_ns)
    if solving_ns >= waiting_ns:
        return "the policy took long"
    arrived_ns = _arrival_ns(arrivals, last, solve, chunk_ns)
    if arrived_ns is None:
        return "the attitude or the policy loop was late"
    attitude_ns = min(waiting_ns, max(0.0, arrived_ns - free_ns))
    loop_ns = waiting_ns - attitude_ns
    if solving_ns >= max(attitude_ns, loop_ns):
        return "the policy took long"
    return "the attitude came late" if attitude_ns > loop_ns else "the policy loop began late"


def _arrival_ns(
    arrivals: Arrivals | None, last: FlownChunk, solve: FlownChunk, chunk_ns: float
) -> int | None:
    """Return the arrival of the first attitude that could have started a solve; None: not recorded.

    It is newer than the last solve's attitude by half a period: the loop takes one that comes a
    quarter of a period early, and its due time can follow a late solve by half a period.
    """
    if arrivals is None or last.attitude_ns is None or solve.attitude_ns is None:
        return None
    usable_ns = min(last.attitude_ns + round(chunk_ns / 2), solve.attitude_ns)
    number = int(np.searchsorted(arrivals.happened_ns, usable_ns))
    if number == len(arrivals.happened_ns):
        return None
    if int(arrivals.happened_ns[number]) > solve.attitude_ns:
        return None  # the attitude used is not in the table: its row was lost
    return int(arrivals.arrived_ns[number])


def worst_moments(
    cameras: Mapping[str, RecordedFlight],
    ticks: Sequence[Tick],
    delays: Sequence[Moment],
    limits: FreshnessLimits,
) -> tuple[Moment, ...]:
    """Return the ``MOMENTS`` worst, at least ``APART_S`` apart, starting with the worst.

    ``cameras``: the recording with the images of each camera, by name, in the contract's order;
    ``limits`` are the age limits of the flown chunks.
    """
    if not ticks:
        return ()
    flight = next(iter(cameras.values()))
    moments = [
        *_crash(flight, ticks),
        *_ends(ticks, flight.meta.outcome),
        *delays,
        *_coasting(ticks, limits),
        *_old_images(ticks),
        *_image_gaps(cameras, ticks),
        *_rows_lost(flight, ticks),
    ]
    groups: list[list[Moment]] = []
    for moment in sorted(moments, key=lambda moment: -moment.severity_ms):
        near = next((one for one in groups if abs(moment.t_s - one[0].t_s) < APART_S), None)
        if near is None:
            groups.append([moment])
        elif all(moment.what != other.what for other in near):
            near.append(moment)
    told = []
    for worst, *others in groups[:MOMENTS]:
        phrases = [worst.detail, *(f"{other.what}: {other.detail}" for other in others)]
        told.append(replace(worst, detail="; ".join(phrases)))
    return tuple(told)


def _crash(flight: RecordedFlight, ticks: Sequence[Tick]) -> Iterator[Moment]:
    """Yield the first crash in the ticks. The meta of a recording that was cut off cannot report
    one, so its ticks are searched, too."""
    if flight.meta.finished and flight.meta.crash is None:
        return
    watch = CrashWatch()
    for tick in ticks:
        watch.see(tick)
        if watch.reason is not None:
            yield Moment(_t_s(ticks, tick.woke_ns), "crash", CRASH_MS, watch.reason)
            return


def _ends(ticks: Sequence[Tick], outcome: FlightOutcome | None) -> Iterator[Moment]:
    """Yield unplanned ends, also that by the guard's death, after which there is no tick."""
    if ticks[-1].trace is not None and outcome is not None and outcome.end == "fault":
        yield _end(ticks, ticks[-1], ticks[-1].woke_ns, outcome.reason)
    for last, tick in pairwise(ticks):
        reason = tick.release_reason
        is_asked = reason is not None and (reason.kind is Kind.END or reason.code is Code.OPERATOR)
        is_planned = is_asked or (tick.phase == "ended" and reason is None)
        if last.trace is not None and tick.trace is None and not is_planned:
            yield _end(ticks, last, tick.woke_ns, reason)


def _end(ticks: Sequence[Tick], last: Tick, at_ns: int, reason: Reason | None) -> Moment:
    detail = f"{reason or 'no reason was recorded'}{_ages(last)}"
    return Moment(_t_s(ticks, at_ns), "the policy's flight ended", END_MS, detail)


def _ages(tick: Tick) -> str:
    """Return the ages of the data behind a tick's sticks, as the end of a phrase."""
    attitude_ns = None if tick.state is None else tick.state.attitude_ns
    parts = [
        f"{name} of {(tick.sent_ns - at_ns) / NS_PER_MS:.0f} ms ago"
        for name, at_ns in (("an attitude", attitude_ns), ("an image", tick.feature_captured_ns))
        if at_ns is not None
    ]
    return f"; its last sticks were by {' and '.join(parts)}" if parts else ""


def _coasting(ticks: Sequence[Tick], limits: FreshnessLimits) -> Iterator[Moment]:
    """Yield sends of an outdated chunk, up to the first send of a fresh one."""
    at = 0
    for is_coasting, group in groupby(ticks, lambda tick: tick.is_coasting and bool(tick.trace)):
        run = list(group)
        at += len(run)
        end_ns = ticks[at].woke_ns if at < len(ticks) else run[-1].sent_ns
        lasted_ms = (end_ns - run[0].woke_ns) / NS_PER_MS
        if is_coasting and lasted_ms >= LEAST_MS:
            detail = f"for {lasted_ms:.0f} ms along an old chunk: {_staleness(run[0], limits)}"
            yield Moment(_t_s(ticks, run[0].woke_ns), "coasting", lasted_ms, detail)


def _staleness(tick: Tick, limits: FreshnessLimits) -> str:
    """Return why the chunk of a tick was outdated; in the order of the guard's own check."""
    state = tick.state
    if state is not None:
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


def _old_images(ticks: Sequence[Tick]) -> Iterator[Moment]:
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
            detail = f"sticks by an image of {age_ns / NS_PER_MS:.0f} ms ago"
            older_ms = (age_ns - usual_ns) / NS_PER_MS
            yield Moment(_t_s(ticks, tick.woke_ns), "old image", older_ms, detail)


def _image_gaps(cameras: Mapping[str, RecordedFlight], ticks: Sequence[Tick]) -> Iterator[Moment]:
    """Yield gaps between exposures from the first tick to the last, except the recorder's."""
    for number, (name, flight) in enumerate(cameras.items()):
        period_ms = 1000 / _image_hz(flight.meta, number)
        which = f" of camera {name}" if len(cameras) > 1 else ""
        for last, frame in pairwise(flight.frame_rows()):
            gap_ms = (frame.captured_ns - last.captured_ns) / NS_PER_MS
            is_in_flight = ticks[0].woke_ns <= frame.captured_ns <= ticks[-1].woke_ns
            if gap_ms > IMAGE_PERIODS * period_ms and is_in_flight and not frame.dropped_before:
                detail = f"{gap_ms:.0f} ms without an exposure{which} that was used"
                at_s = _t_s(ticks, frame.captured_ns)
                yield Moment(at_s, "gap between images", gap_ms - period_ms, detail)


def _image_hz(meta: FlightMeta, number: int) -> float:
    """Return the most images a second of a camera; the meta has that of the first."""
    if number == 0 or not meta.contract.camera_rates_hz:
        return meta.visual_hz
    own_hz = meta.contract.camera_rates_hz[number]
    return min(own_hz, meta.plan.get("vision_hz", own_hz))


def _rows_lost(flight: RecordedFlight, ticks: Sequence[Tick]) -> Iterator[Moment]:
    dropped = flight.ticks.column("dropped_before").to_pylist()
    woke_ns = flight.ticks.column("woke_ns").to_pylist()
    for count, before_ns, at_ns in zip(dropped, woke_ns[:1] + woke_ns, woke_ns, strict=False):
        if count:
            detail = (
                f"{count} ticks before this are not in the recording: the recorder fell behind, or "
                "its file is damaged"
            )
            lost_ms = (at_ns - before_ns) / NS_PER_MS
            yield Moment(_t_s(ticks, at_ns), "rows lost", lost_ms, detail)
