"""Analysis of a recorded flight: figures, who held the sticks, and the worst moments."""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby, pairwise
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from mavbridge.commands.inspect.moments import Arrivals, find_delays, is_gap, worst_moments
from mavbridge.config.flight import Limits
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.course import CourseGate, read_gates
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.histogram import Histogram
from mavbridge.core.reasons import Reason
from mavbridge.core.records import Position, Solve, Tick
from mavbridge.core.vehicle import Percentiles
from mavbridge.flight.settings import effective_freshness
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.observe.terminal import BAD, POOR, Finding, findings, number, rate_style
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport, VisionReport
from mavbridge.recording import replay_files
from mavbridge.recording.flight_folder import RecordedFlight, open_cameras
from mavbridge.recording.replay_files import read_settings
from mavbridge.recording.rows import FrameRow
from policy.contract import Contract
from policy.data.flight_files import PACKETS, SOLVES, table_file
from policy.data.tables import read_table

FloatColumn: TypeAlias = NDArray[np.floating]
ATTITUDES = (30, 31)
"""Message ids of ATTITUDE and ATTITUDE_QUATERNION (MAVLink, common.xml)."""

Holder = Literal["policy", "read-only", "idle", "neutral", "release", "pilot"]
"""idle: ours, before the policy flies; neutral: ours, on the way out; release: given back, not yet
confirmed; pilot: another holder while we send nothing, such as a receiver or the autopilot
alone."""


@dataclass(frozen=True, kw_only=True)
class HolderSpan:
    """Stretch of time with one holder."""

    start_s: float
    """Time since the first tick."""
    end_s: float
    holder: Holder
    reason: Reason | None
    """Why the policy did not fly, for most of the span; None while it flew."""


def _holder(tick: Tick, *, keeps_neutral: bool) -> Holder:
    if tick.trace is not None:
        return "read-only" if tick.readonly else "policy"
    if tick.sent is not None or (keeps_neutral and tick.lacks_neutral):
        return "idle" if tick.phase == "preparing" else "neutral"
    return "release" if tick.phase == "releasing" else "pilot"


def holder_spans(
    ticks: Sequence[Tick], start_ns: int, *, keeps_neutral: bool
) -> tuple[HolderSpan, ...]:
    """Return the stretches in the order of time, each with its longest-lasting reason. A new reason
    does not start a new stretch.

    ``keeps_neutral`` is that of ``FlightMeta``.
    """
    spans: list[HolderSpan] = []
    ends_ns = [tick.woke_ns for tick in ticks[1:]] + [tick.woke_ns for tick in ticks[-1:]]
    for holder, group in groupby(
        zip(ticks, ends_ns, strict=True),
        lambda pair: _holder(pair[0], keeps_neutral=keeps_neutral),
    ):
        span = list(group)
        lasted_ns: Counter[object] = Counter()
        reasons: dict[object, Reason | None] = {}
        for tick, end_ns in span:
            reason = None if tick.trace is not None else tick.release_reason
            key = None if reason is None else reason.key
            lasted_ns[key] += end_ns - tick.woke_ns
            reasons[key] = reason
        spans.append(
            HolderSpan(
                start_s=(span[0][0].woke_ns - start_ns) / NS_PER_S,
                end_s=(span[-1][1] - start_ns) / NS_PER_S,
                holder=holder,
                reason=reasons[lasted_ns.most_common(1)[0][0]],
            )
        )
    return tuple(spans)


@dataclass(frozen=True, kw_only=True)
class Track:
    """Positions in the order of time."""

    t_s: FloatColumn
    """[M] seconds since the first tick."""
    position_ned_m: FloatColumn
    """[M, 3] from the estimator's origin."""

    @property
    def length_m(self) -> float:
        """Length of the path."""
        steps_m = np.linalg.norm(np.diff(self.position_ned_m, axis=0), axis=1)
        return float(steps_m.sum())


class FlightAnalysis:
    """One recorded flight."""

    def __init__(self, folder: Path, *, gates: Path | None = None) -> None:
        """Read the flight; ``gates`` is a file of ``read_gates``, for an unknown course."""
        opened = open_cameras(folder)
        self.folder = folder
        self.recorded = opened[0]
        """The recording, with the images of its first camera."""
        self.meta = meta = self.recorded.meta
        self.ticks: pa.Table = self.recorded.ticks
        self.cameras = dict(zip(meta.contract.cameras, opened, strict=True))
        """The recording with the images of each camera, by name, in the contract's order."""
        ticks = [row.tick for row in self.recorded.tick_rows()]
        frames = list(self.recorded.frame_rows())
        damage = [text for camera in opened for text in camera.damage]
        self.start_ns = ticks[0].woke_ns if ticks else meta.start_ns
        """Wake-up of the first tick, on the clock of all stamps."""
        self.stick_hz = meta.plan.get("stick_hz", meta.action_hz)
        """Rate of the stick grid; without a policy, of the rows."""
        self.report = _report(opened, ticks, frames, self.stick_hz)
        """Figures of the table that ended the flight, except for those of the link; vision is that
        of the first camera."""
        self.image_latency_ms = {name: _latency_ms(each) for name, each in self.cameras.items()}
        """Time from the exposure to the finished feature, by camera; None without images."""
        self.track = _track(ticks, frames, self.start_ns)
        """None if no position is known."""
        self.gates = course_gates(meta.course_seed) if gates is None else read_gates(gates)
        """Empty if the course is unknown."""
        self.holders = holder_spans(ticks, self.start_ns, keeps_neutral=meta.keeps_neutral)
        self.delays = find_delays(
            ticks,
            stick_hz=self.stick_hz,
            action_hz=meta.action_hz,
            arrivals=_read_arrivals(folder, damage),
        )
        """Missed slots and late chunks in the order of time, each with its cause."""
        self.limits = _flown_limits(folder, meta.contract)
        """Maximum ages when a stick is sent."""
        self.moments = worst_moments(self.cameras, ticks, self.delays, self.limits)
        """The ten worst, starting with the worst."""
        self.damage = tuple(dict.fromkeys(damage))
        """Skipped parts of the recording, in sentences for the user."""

    @property
    def times_ms(self) -> dict[str, Percentiles | None]:
        """Measured times by name; None: not measured."""
        first = next(iter(self.image_latency_ms.values()))
        return self.report.times_ms | {"exposure to feature": first}

    @property
    def causes(self) -> tuple[tuple[str, int], ...]:
        """Number of late chunks and missed slots by cause, the most frequent first."""
        counts: Counter[str] = Counter()
        for delay in self.delays:
            if delay.cause is not None:
                counts[delay.cause] += delay.count
        return tuple(counts.most_common())


def _report(
    cameras: Sequence[RecordedFlight], ticks: list[Tick], frames: list[FrameRow], stick_hz: float
) -> TimingReport:
    """Count the rows as in flight, except for figures that only a live flight has."""
    meta = cameras[0].meta
    timing = FlightTiming(stick_hz=stick_hz, action_hz=meta.action_hz, vision_hz=meta.visual_hz)
    for tick in _with_gaps(ticks):
        timing.emit(tick)
    report = timing.report(
        mode=meta.mode,
        engine=meta.engine or "an engine that is not known",
        policy=meta.policy or meta.source,
        autopilot=meta.autopilot,
        observer_drops=ObserverDrops(recorder=_losses(cameras)),
        outcome=meta.outcome,
    )
    return replace(report, vision=_vision(frames, meta.visual_hz))


def _with_gaps(ticks: Sequence[Tick]) -> Iterator[Tick]:
    """Yield the ticks, and one without sticks in each gap, across which nothing is measured."""
    yield from ticks[:1]
    for last, tick in pairwise(ticks):
        if is_gap(last, tick):
            yield replace(last, trace=None)
        yield tick


def _losses(cameras: Sequence[RecordedFlight]) -> int:
    """Return the recorder's losses; of a recording that was cut off, up to its last row."""
    meta = cameras[0].meta
    counts = (meta.ticks_dropped, meta.frames_dropped, meta.packets_dropped)
    if any(count is not None for count in counts):
        return sum(count or 0 for count in counts)
    tables = (cameras[0].ticks, *(camera.frames for camera in cameras))
    return sum(sum(table.column("dropped_before").to_pylist()) for table in tables)


def _vision(frames: Sequence[FrameRow], visual_hz: float) -> VisionReport:
    """Count the images by their exposures, including those that only the recorder has lost.

    A recording contains neither the camera's drops nor the start of an encoding.
    """
    count = sum(1 + frame.dropped_before for frame in frames)
    rate_hz: float | None = None
    if len(frames) > 1 and (span_ns := frames[-1].captured_ns - frames[0].captured_ns) > 0:
        intervals = count - 1 - frames[0].dropped_before
        rate_hz = round(intervals * NS_PER_S / span_ns, 3)
    return VisionReport(
        target_hz=visual_hz, rate_hz=rate_hz, frames=count, dropped_frames=None, encode_ms=None
    )


def _latency_ms(camera: RecordedFlight) -> Percentiles | None:
    latency = Histogram()
    for frame in camera.frame_rows():
        latency.add(frame.ready_ns - frame.captured_ns)
    return latency.percentiles_ms()


def course_gates(seed: int | None) -> tuple[CourseGate, ...]:
    """Return the gates of a simulated course; none without a seed."""
    if seed is None:
        return ()
    from sitl.course import make_course

    return tuple(
        CourseGate(Position(*gate.center_ned_m), gate.yaw_rad, gate.size_m)
        for gate in make_course(seed).gates
    )


def _track(ticks: Sequence[Tick], frames: Sequence[FrameRow], start_ns: int) -> Track | None:
    """Return the simulator's true positions, else the positions in the ticks."""
    known = [
        (frame.captured_ns, frame.truth.position_ned_m)
        for frame in frames
        if frame.truth is not None
    ] or [(tick.woke_ns, tick.position_ned_m) for tick in ticks if tick.position_ned_m is not None]
    if not known:
        return None
    stamps_ns, positions = zip(*known, strict=True)
    t_s = (np.array(stamps_ns) - start_ns) / NS_PER_S
    return Track(t_s=t_s, position_ned_m=np.array(positions))


def _flown_limits(folder: Path, contract: Contract) -> FreshnessLimits:
    """Return the age limits when a stick is sent: the recorded flags', else the contract's."""
    try:
        limits = effective_freshness(contract, read_settings(folder).config.limits)
    except MavbridgeError:  # no settings, or those of another version
        limits = effective_freshness(contract, Limits())
    return limits.while_played(round(contract.play_s * NS_PER_S))


def _read_arrivals(folder: Path, damage: list[str]) -> Arrivals | None:
    """Return the attitudes that reached the flight process; None if no table tells.

    A sentence about any loss is appended to ``damage``.
    """
    if not table_file(folder / PACKETS).exists():
        return None
    try:
        table = read_table(folder / PACKETS, replay_files.PACKETS, damage=damage)
    except MavbridgeError as error:
        damage.append(str(error))
        return None
    columns = {name: table.column(name).to_numpy() for name in table.column_names}
    rows = np.flatnonzero(np.isin(columns["message_id"], ATTITUDES))
    if not len(rows):
        return None
    rows = rows[np.argsort(columns["happened_ns"][rows], kind="stable")]
    return Arrivals(columns["happened_ns"][rows], columns["arrived_ns"][rows])


def recorded_solves(flight: RecordedFlight) -> Iterator[Solve]:
    """Return the policy's solves in the order of time; nothing if they were not recorded."""
    if table_file(stem := flight.folder / SOLVES).exists():
        table = read_table(stem, replay_files.SOLVES)
        yield from replay_files.read_solves(table, flight.meta.contract)


def flight_facts(flight: FlightAnalysis) -> Iterator[Finding]:
    """Yield losses, crash, course and path of a flight."""
    meta = flight.meta
    if meta.loss is not None:
        yield Finding("recording", meta.loss, POOR)
    if meta.crash is not None:
        yield Finding("crashed", meta.crash, BAD)
    for text in flight.damage:
        yield Finding("damage", text, BAD)
    if meta.gates_passed is not None:
        result = {True: "finished", False: "not finished", None: "no verdict"}[meta.success]
        text = f"{meta.course_seed}: {meta.gates_passed} gates passed, {result}"
        yield Finding("course", text, BAD if meta.success is False else "")
    if (track := flight.track) is not None:
        highest_m = -track.position_ned_m[:, 2].min()
        yield Finding("path", f"{track.length_m:.0f} m, highest {highest_m:.1f} m")


def flight_findings(flight: FlightAnalysis) -> Iterator[Finding]:
    """Yield the findings on the loops, or on a pilot's rows; then image latencies and causes."""
    report = flight.report
    if flight.meta.source == "pilot":
        yield from _pilot_findings(flight)
    else:
        yield from findings(report)
    for camera, latency in flight.image_latency_ms.items():
        if latency is not None:
            text = f"p50 {latency.p50:.1f}, p99 {latency.p99:.1f} ms from exposure to feature"
            yield Finding("images", f"{camera}: {text}" if len(flight.cameras) > 1 else text)
    if flight.causes:
        causes = ", ".join(f"{cause} ({count})" for cause, count in flight.causes)
        yield Finding("causes", causes, POOR)


def _pilot_findings(flight: FlightAnalysis) -> Iterator[Finding]:
    """Yield the findings on a recording in which no policy flew."""
    report, sticks = flight.report, flight.ticks["rc_sticks"]
    is_timed = len(sticks) > 1 and report.duration_s > 0
    rows_hz = (len(sticks) - 1) / report.duration_s if is_timed else None
    known = 1 - sticks.null_count / max(len(sticks), 1)
    share = f", the pilot's sticks known in {known:.1%} of them" if len(sticks) else ""
    text = f"{number(rows_hz, 1)} Hz of {flight.meta.action_hz:.4g} Hz{share}"
    yield Finding("rows", text, rate_style(rows_hz, flight.meta.action_hz))
    yield from (each for each in findings(report) if each.name in ("vision", "recorder"))
