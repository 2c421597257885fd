"""A flight in the Rerun viewer.

The view is the consumer of an ``ObserverThread``: the SDK blocks its caller while a viewer does not
keep up, even at the end of the flight. The caller is therefore that thread, whose queue drops and
counts events and whose ``close`` has a deadline.
"""

import math
from bisect import bisect_right
from collections.abc import Iterator, Sequence
from itertools import groupby
from pathlib import Path
from textwrap import wrap
from uuid import uuid4

import rerun as rr

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import Observed, Solve, Tick, VisionTick
from mavbridge.observe import viewer_layout as layout
from mavbridge.observe.viewer_layout import ViewedFlight, flight_blueprint
from mavbridge.observe.viewer_plots import ActionPlots, Columns, TimingPlots
from mavbridge.observe.viewer_scene import PlanView, SceneView
from mavbridge.observe.viewer_target import prepare_target

EVENT_CHARACTERS = 64
"""Longer texts continue in the next line; the viewer cuts them off at the edge of its panel."""

BATCHES_OF_ROWS = 3
"""Plots, the scene and the images advance in steps of this many batches."""


class RerunView:
    """Shows ticks, solves and vision ticks on the timeline ``time``, from the first one on.

    Values of a tick are stamped with its wake-up, values of a frame with the end of its encoding,
    images with their exposure. An unmeasured value is a gap in its line.
    """

    def __init__(self, target: str, flight: ViewedFlight, *, is_live: bool = False) -> None:
        """Ready the target, as ``prepare_target`` does; ``consume`` and ``close`` alone can block.

        ``is_live``: a file is opened, and an older one replaced, only once the vehicle is heard.
        Otherwise it is a recording, whose images have no start of encoding and no count of drops.
        """
        self._flight = flight
        prepared = prepare_target(target)
        self._file = prepared if isinstance(prepared, Path) else None
        self._sink = rr.FileSink(self._file) if self._file else rr.GrpcSink(str(prepared))
        rr.unregister_shutdown()  # its atexit hook waits forever for a stalled viewer
        self._stream = rr.RecordingStream("mavbridge", recording_id=uuid4())
        self._is_open = False
        self._awaits_vehicle = is_live and self._file is not None
        self._has_start = False
        self._until_ns = 0
        """Newest stamp of a plotted event."""
        columns = Columns(self._stream)
        self._columns = columns
        self._timing = TimingPlots(columns, flight, is_live=is_live)
        self._actions = ActionPlots(columns, flight)
        self._scene = SceneView(columns, flight)
        self._plan = PlanView(columns, flight)
        self._last_tick: Tick | None = None
        self._batches = 0

    def consume(self, batch: Sequence[Observed]) -> None:
        """Send one batch; blocks while the viewer does not keep up."""
        ticks = [event for event in batch if isinstance(event, Tick)]
        if self._awaits_vehicle and all(tick.mode is None for tick in ticks):
            return
        self._awaits_vehicle = False
        self._open()
        solves = [event for event in batch if isinstance(event, Solve)]
        visions = [event for event in batch if isinstance(event, VisionTick)]
        if batch and not self._has_start:
            self._has_start = True
            firsts: tuple[Observed, ...] = (*ticks[:1], *visions[:1], *solves[:1])
            self._columns.start_ns = _happened_ns(firsts[0])
            self._mark(self._columns.start_ns)
        stamps_ns = (*(tick.sent_ns for tick in ticks), *(each.ready_ns for each in visions))
        self._until_ns = max((self._until_ns, *stamps_ns))
        if ticks:
            self._timing.show_ticks(ticks)
            self._actions.show(ticks)
            self._scene.show_ticks(ticks)
            self._show_events(ticks)
        self._show_plans(solves, ticks)
        for camera, images in groupby(visions, key=lambda vision: vision.camera):
            of_camera = list(images)
            if camera == 0:
                self._timing.show_visions(of_camera)
            self._scene.show_images(of_camera)
        self._last_tick = ticks[-1] if ticks else self._last_tick
        self._batches += 1
        if self._batches % BATCHES_OF_ROWS == 0:
            self._columns.flush()

    def close(self) -> None:
        """Deliver the rest and block until it is taken; raise MavbridgeError if it was not."""
        if self._awaits_vehicle:
            return
        self._open()
        self._timing.close()
        if self._has_start:
            self._mark(self._until_ns)
        self._columns.flush()
        try:
            self._stream.flush()
            self._stream.disconnect()
        except RuntimeError as error:
            told = f"the viewer did not take the whole recording: {error}"
            if self._file is not None:
                told = f"{self._file} is not complete ({error}): make room on its disk"
            raise MavbridgeError(told) from error

    def _open(self) -> None:
        if self._is_open:
            return
        self._is_open = True
        self._stream.set_sinks(self._sink, default_blueprint=flight_blueprint(self._flight))
        for path, style in layout.styles(self._flight.contract.action):
            self._stream.log(path, style, static=True, strict=True)
        self._scene.open()

    def _mark(self, stamp_ns: int) -> None:
        """Show a gap in every plot, so that all of them reach as far."""
        for plot in (*layout.PLOTS, *layout.action_plots(self._flight.contract.action)):
            self._columns.plot(plot, [stamp_ns], [(math.nan,) * len(plot.series)])

    def _show_plans(self, solves: Sequence[Solve], ticks: Sequence[Tick]) -> None:
        """Show the policy's plans while it flies, each from the vehicle's position at its time."""
        known = [tick for tick in (self._last_tick, *ticks) if tick is not None]
        stamps_ns = [tick.woke_ns for tick in known]
        for solve in solves:
            place = bisect_right(stamps_ns, solve.computed_ns) - 1
            if place >= 0 and known[place].trace is not None:
                self._plan.show(solve, known[place].position_ned_m)

    def _show_events(self, ticks: Sequence[Tick]) -> None:
        before = [self._last_tick, *ticks[:-1]]
        stamps_ns: list[int] = []
        rows: list[tuple[str, str, layout.Rgb]] = []
        for last, tick in zip(before, ticks, strict=True):
            since_s = (tick.woke_ns - self._columns.start_ns) / NS_PER_S
            for text, level, color in _changes(last, tick):
                for number, line in enumerate(wrap(text, EVENT_CHARACTERS) or [""]):
                    margin = f"{since_s:6.2f} s  " if number == 0 else " " * 10
                    rows.append((margin + line, level, color))
                    stamps_ns.append(tick.woke_ns)
        if rows:
            texts, levels, colors = zip(*rows, strict=True)
            columns = rr.TextLog.columns(text=texts, level=levels, color=colors)
            self._columns.send(layout.EVENTS, stamps_ns, columns)


def _happened_ns(event: Observed) -> int:
    if isinstance(event, Tick):
        return event.woke_ns
    return event.captured_ns if isinstance(event, VisionTick) else event.started_ns


def _changes(before: Tick | None, now: Tick) -> Iterator[tuple[str, str, layout.Rgb]]:
    """Return text, level and colour of everything in this tick that is new to the user."""
    if before is None or before.stage != now.stage:
        if now.release_reason is None:
            yield now.activity, "INFO", layout.GREEN if now.trace else layout.GREY
        else:
            yield now.activity, "WARN", layout.ORANGE
    if now.mode is not None and (before is None or before.mode != now.mode):
        yield f"mode {now.mode}", "INFO", layout.GREY
    if before is None or before.armed != now.armed:
        yield "armed" if now.armed else "disarmed", "INFO", layout.GREY
    for text in now.texts:
        yield text, "INFO", layout.GREY
