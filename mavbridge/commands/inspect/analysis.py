"""What a recorded flight tells: figures, who held the sticks, and the moments that went worst."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from mavbridge.commands.inspect.holders import HolderSpan, holder_spans
from mavbridge.commands.inspect.moments import Delay, Moment, find_delays, worst_moments
from mavbridge.commands.inspect.series import FloatColumn, Series, make_series
from mavbridge.commands.inspect.track import Track, course_gates, read_track
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.course import CourseGate, read_gates
from mavbridge.core.histogram import Histogram
from mavbridge.core.records import Tick, VisionTick
from mavbridge.core.vehicle import Percentiles
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport
from mavbridge.recording.flight_folder import RecordedFlight, open_flight
from mavbridge.recording.meta import FlightMeta
from mavbridge.recording.rows import FrameRow

_NO_IMAGE = np.zeros((1, 1, 3), np.uint8)


@dataclass(frozen=True, kw_only=True)
class Images:
    """When the images of one camera were exposed; row k is image k of its video."""

    video: Path
    exposed_s: FloatColumn
    """[M] seconds since the first tick."""
    latency_ms: Percentiles | None
    """From the exposure to the finished feature; None without images."""


@dataclass(frozen=True, kw_only=True)
class FlightAnalysis:
    """One recorded flight."""

    folder: Path
    meta: FlightMeta
    stick_hz: float
    """Rate of the stick grid, by the slots themselves."""
    report: TimingReport
    """The figures of the table that ended the flight, but for those of the link."""
    series: Series
    images: Images
    track: Track | None
    """None where no position is known."""
    gates: tuple[CourseGate, ...]
    """Empty where the course is not known."""
    holders: tuple[HolderSpan, ...]
    delays: tuple[Delay, ...]
    """Missed slots and late chunks, each with its cause, in the order of time."""
    moments: tuple[Moment, ...]
    """The ten worst, the worst one first."""

    @property
    def causes(self) -> tuple[tuple[str, int], ...]:
        """How often each cause made a chunk late or missed slots, the most frequent first."""
        counts: dict[str, int] = {}
        for delay in self.delays:
            counts[delay.cause] = counts.get(delay.cause, 0) + delay.count
        return tuple(sorted(counts.items(), key=lambda item: -item[1]))


def analyse(folder: Path, *, gates: Path | None = None) -> FlightAnalysis:
    """Read a recorded flight; ``gates`` is a file of ``read_gates``, for one that knows no course.

    Raises:
        MavbridgeError: it is no recorded flight, or a damaged one.
    """
    flight = open_flight(folder)
    ticks = [row.tick for row in flight.tick_rows()]
    frames = list(flight.frame_rows())
    series = make_series(flight, ticks)
    stick_hz = _stick_hz(ticks, flight.meta)
    delays = find_delays(ticks, stick_hz=stick_hz, action_hz=flight.meta.action_hz)
    return FlightAnalysis(
        folder=folder,
        meta=flight.meta,
        stick_hz=stick_hz,
        report=_report(flight, ticks, frames, stick_hz),
        series=series,
        images=_images(flight, frames, series.start_ns),
        track=read_track(flight, series, frames),
        gates=course_gates(flight.meta.course_seed) if gates is None else read_gates(gates),
        holders=holder_spans(ticks, series.start_ns),
        delays=delays,
        moments=worst_moments(flight, ticks, frames, delays),
    )


def _stick_hz(ticks: Iterable[Tick], meta: FlightMeta) -> float:
    """Rate of the grid, by the median time from one slot to the next; else that of the actions."""
    due_ns = np.array([tick.due_ns for tick in ticks if tick.is_slot and tick.due_ns > 0], np.int64)
    periods_ns = due_ns[1:] - due_ns[:-1]
    periods_ns = periods_ns[periods_ns > 0]
    if not len(periods_ns):
        return meta.action_hz
    return round(NS_PER_S / float(np.median(periods_ns)), 1)


def _report(
    flight: RecordedFlight, ticks: list[Tick], frames: list[FrameRow], stick_hz: float
) -> TimingReport:
    """Count the rows as they were counted in flight."""
    meta = flight.meta
    timing = FlightTiming(stick_hz=stick_hz, action_hz=meta.action_hz, vision_hz=meta.visual_hz)
    dropped = 0
    for serial, frame in enumerate(frames):
        dropped += frame.dropped_before
        timing.emit(
            VisionTick(
                serial=serial,
                frame_id=frame.frame_id,
                captured_ns=frame.captured_ns,
                started_ns=frame.captured_ns,
                ready_ns=frame.ready_ns,
                dropped_frames=dropped,
                rgb=_NO_IMAGE,
            )
        )
    for tick in ticks:
        timing.emit(tick)
    losses = (meta.ticks_dropped, meta.frames_dropped, meta.packets_dropped)
    report = timing.report(
        mode=meta.mode,
        engine=meta.engine or "an engine that is not known",
        policy=meta.policy or meta.source,
        autopilot=meta.autopilot,
        link=None,
        observer_drops=ObserverDrops(rerun=None, recorder=sum(loss or 0 for loss in losses)),
    )
    # A recording has no stamp for the start of an encoding: ``Images.latency_ms`` is measured.
    return replace(report, vision=replace(report.vision, encode_ms=None))


def _images(flight: RecordedFlight, frames: list[FrameRow], start_ns: int) -> Images:
    latency = Histogram()
    for frame in frames:
        latency.add(frame.ready_ns - frame.captured_ns)
    exposed_ns = np.array([frame.captured_ns for frame in frames], np.int64)
    return Images(
        video=flight.folder / flight.video,
        exposed_s=(exposed_ns - start_ns) / NS_PER_S,
        latency_ms=latency.percentiles_ms(),
    )


def histogram(values_ms: FloatColumn, *, edges_ms: FloatColumn) -> list[int]:
    """How many values lie between each pair of edges; the last bin takes all beyond it."""
    known = values_ms[np.isfinite(values_ms)]
    counts, _ = np.histogram(np.minimum(known, edges_ms[-1]), bins=edges_ms)
    return [int(count) for count in counts]
