"""A flight in the Rerun viewer.

The view is the consumer of an ``ObserverThread``: the SDK blocks its caller while a viewer does not
keep up, even at the end of the flight, so the caller is that thread, whose queue drops and counts
events and whose ``close`` has a deadline. Each batch becomes one ``send_columns`` per plot, which
costs a tenth of one ``log`` per value.
"""

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import ImageArray, Observed, Tick, VisionTick
from mavbridge.core.vehicle import ACTION_CLASSES, Action, ActionKind, Sticks
from mavbridge.observe.rerun_target import RerunRecording

JPEG_QUALITY = 85
MAX_IMAGE_WIDTH = 640
"""Wider images are scaled down, since the viewer does not show them any larger."""

CAMERA = "camera"
EVENTS = "events"

FloatColumn: TypeAlias = NDArray[np.float64]
_STICKS_GAP = Sticks(math.nan, math.nan, math.nan, math.nan)

_Rgb: TypeAlias = tuple[int, int, int]
_BLUE, _ORANGE, _GREEN = (86, 180, 233), (240, 160, 40), (60, 200, 140)
_PINK, _YELLOW, _WHITE, _GREY = (225, 120, 180), (240, 228, 66), (235, 235, 235), (135, 135, 135)


class _Series(NamedTuple):
    name: str
    color: _Rgb
    width: float = 1.5


class _Plot(NamedTuple):
    """One entity: series that share their stamps."""

    path: str
    series: tuple[_Series, ...]


AGE = _Plot("age", (_Series("feature age", _BLUE), _Series("state age", _ORANGE)))
ACTION_PERIOD = _Plot("period/action", (_Series("action", _BLUE),))
VISION_PERIOD = _Plot("period/vision", (_Series("vision", _ORANGE),))
LATENESS = _Plot("lateness/sticks", (_Series("sticks after their slot", _BLUE),))
VISION_JITTER = _Plot("jitter/vision", (_Series("vision: |period - target|", _ORANGE),))
PREDICT = _Plot("compute/action", (_Series("predict", _BLUE),))
ENCODE = _Plot("compute/vision", (_Series("encode", _ORANGE),))
MISSED = _Plot("missed/action", (_Series("missed slots", _BLUE),))
DROPPED = _Plot("missed/vision", (_Series("dropped frames", _ORANGE),))
_STICK_SERIES = (
    _Series("vehicle's echo", _GREEN, width=4),  # first: drawn under the sticks
    _Series("raw", _GREY),
    _Series("clipped", _PINK),
    _Series("slewed", _YELLOW),
    _Series("smoothed", _BLUE),
    _Series("sent", _WHITE),
)
_RC_COLORS = enumerate((_BLUE, _ORANGE, _GREEN, _PINK), start=1)
RC = _Plot("rc", tuple(_Series(f"channel {number}", color) for number, color in _RC_COLORS))
"""Channels 1 to 4 hold the sticks, unless RCMAP_* says otherwise; the stick plots are mapped."""
PLOTS = (
    *(AGE, ACTION_PERIOD, VISION_PERIOD, LATENESS, VISION_JITTER),
    *(PREDICT, ENCODE, MISSED, DROPPED, RC),
)
_EVENT_COLUMNS = rrb.TextLogColumns(timeline_columns=[], text_log_columns=["Body"])
"""The viewer's own time column is too narrow to read, so the text starts with the time."""


def action_plots(action: ActionKind) -> tuple[_Plot, ...]:
    """One plot for each of the four numbers of an action of this kind."""
    return tuple(
        _Plot(f"{action}/{name}", _STICK_SERIES) for name in ACTION_CLASSES[action]._fields
    )


def flight_blueprint(action: ActionKind = "sticks") -> rrb.Blueprint:
    """Initial layout of the viewer: scene, ages and computing times, loops, actions."""
    scene = rrb.Vertical(
        rrb.Spatial2DView(origin=CAMERA, name="Camera: what the policy sees"),
        rrb.TextLogView(origin=EVENTS, name="Events", columns=_EVENT_COLUMNS),
        row_shares=[3, 2],
    )
    freshness = rrb.Vertical(
        _time_series("Age when sent [ms]", AGE),
        _time_series("Time to compute [ms]", PREDICT, ENCODE),
        _time_series("RC echo from the vehicle [us]", RC),
    )
    loops = rrb.Vertical(
        _time_series("Period of the loops [ms]", ACTION_PERIOD, VISION_PERIOD),
        _time_series("Jitter [ms]", LATENESS, VISION_JITTER),
        _time_series("Missed slots, dropped frames [since the start]", MISSED, DROPPED),
    )
    titles = [name.replace("_", " ") for name in ACTION_CLASSES[action]._fields]
    actions = rrb.Vertical(
        *(
            _time_series(
                f"Stick: {title}" if action == "sticks" else title.capitalize(),
                plot,
                legend=number == 0,
                value_range=(-1.05, 1.05) if action == "sticks" else None,
            )
            for number, (title, plot) in enumerate(zip(titles, action_plots(action), strict=True))
        ),
        row_shares=[4, 3, 3, 3],  # the first contains the legend for all
    )
    return rrb.Blueprint(
        rrb.Horizontal(scene, freshness, loops, actions),
        rrb.TimePanel(state="collapsed", timeline="time"),
        collapse_panels=True,
    )


def _time_series(
    name: str,
    *plots: _Plot,
    legend: bool = True,
    value_range: tuple[float, float] | None = None,
) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=name,
        contents=[f"/{plot.path}" for plot in plots],
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=None if value_range is None else rrb.ScalarAxis(range=value_range),
        plot_legend=rrb.PlotLegend(corner="LeftTop", visible=legend),
    )


class RerunView:
    """Shows ticks and vision ticks on the timelines ``time`` and ``tick``.

    ``time`` starts at the first tick. Values of a tick are stamped with its wake-up, values of a
    frame with the end of its encoding, images with their exposure. A value that was not measured
    is a gap in its line.
    """

    def __init__(self, target: str, *, vision_hz: float, action: ActionKind = "sticks") -> None:
        """Check the target; calls that may block are left to ``consume`` and ``close``.

        Jitter of vision is measured against ``vision_hz``; ``target`` is that of
        ``prepare_target``; ``action`` is the kind of the policy's actions.
        """
        self._action = action
        self._recording = RerunRecording("mavbridge", target)
        self._is_open = False
        self._action_periods, self._vision_periods = _Periods(), _Periods()
        self._vision_period_ms = 1e3 / vision_hz
        self._origin_ns: int | None = None
        self._last_tick: Tick | None = None
        self._missed_slots = 0
        self._first_dropped: int | None = None

    def consume(self, batch: Sequence[Observed]) -> None:
        """Send one batch; blocks while the viewer does not keep up."""
        self._open()
        ticks = [event for event in batch if isinstance(event, Tick)]
        visions = [event for event in batch if isinstance(event, VisionTick)]
        if self._origin_ns is None:
            self._origin_ns = ticks[0].woke_ns if ticks else visions[0].captured_ns
        if visions:
            self._send_visions(visions, ticks)
        if ticks:
            self._send_ticks(ticks)
            self._send_events(ticks)
            self._last_tick = ticks[-1]

    def close(self) -> None:
        """Deliver the rest; blocks until it is taken. Raises MavbridgeError: the viewer is gone."""
        self._open()
        self._recording.close()

    def _open(self) -> None:
        if self._is_open:
            return
        self._is_open = True
        self._recording.open(flight_blueprint(self._action))
        for plot in (*PLOTS, *action_plots(self._action)):
            style = rr.SeriesLines(
                names=[series.name for series in plot.series],
                colors=[series.color for series in plot.series],
                widths=[series.width for series in plot.series],
                aggregation_policy="MinMax",  # zoomed out: averages would hide stalls
            )
            self._recording.stream.log(plot.path, style, static=True, strict=True)

    def _send_ticks(self, ticks: list[Tick]) -> None:
        woke_ns = [tick.woke_ns for tick in ticks]
        index = self._index(woke_ns, [tick.index for tick in ticks])
        missed = self._missed_slots + np.cumsum([tick.missed_slots for tick in ticks])
        self._missed_slots = int(missed[-1])
        self._send(AGE, index, _ms([_ages_ns(tick) for tick in ticks]))
        self._send(ACTION_PERIOD, index, self._action_periods.extend(woke_ns))
        self._send(LATENESS, index, _ms([_lateness_ns(tick) for tick in ticks]))
        self._send(PREDICT, index, _ms([tick.predict_ns for tick in ticks]))
        self._send(MISSED, index, missed)
        stages = np.array([_stages(tick, self._action) for tick in ticks])
        for axis, plot in enumerate(action_plots(self._action)):
            self._send(plot, index, stages[:, :, axis])
        shown_us = [tick.rc_channels_us[: len(RC.series)] for tick in ticks]
        gaps = (math.nan,) * len(RC.series)
        self._send(RC, index, np.array([us + gaps[len(us) :] for us in shown_us]))

    def _send_visions(self, visions: list[VisionTick], ticks: list[Tick]) -> None:
        ready_ns = [vision.ready_ns for vision in visions]
        index = self._index(ready_ns, self._tick_indexes_at(ready_ns, ticks))
        period_ms = self._vision_periods.extend([v.started_ns for v in visions])
        self._send(VISION_PERIOD, index, period_ms)
        self._send(VISION_JITTER, index, np.abs(period_ms - self._vision_period_ms))
        self._send(ENCODE, index, _ms([vision.ready_ns - vision.started_ns for vision in visions]))
        dropped = np.array([vision.dropped_frames for vision in visions])
        if self._first_dropped is None:
            self._first_dropped = int(dropped[0])
        self._send(DROPPED, index, dropped - self._first_dropped)
        captured_ns = [vision.captured_ns for vision in visions]
        index = self._index(captured_ns, self._tick_indexes_at(captured_ns, ticks))
        blobs = [_jpeg(vision.rgb) for vision in visions]
        images = rr.EncodedImage.columns(blob=blobs, media_type=["image/jpeg"] * len(visions))
        self._recording.stream.send_columns(CAMERA, index, images, strict=True)

    def _send_events(self, ticks: list[Tick]) -> None:
        before = [self._last_tick, *ticks[:-1]]
        changes = [
            (tick, *change)
            for last, tick in zip(before, ticks, strict=True)
            for change in _changes(last, tick)
        ]
        if not changes:
            return
        changed, texts, levels, colors = zip(*changes, strict=True)
        since_s = [(tick.woke_ns - (self._origin_ns or 0)) / NS_PER_S for tick in changed]
        lines = [f"{t_s:6.2f} s  {text}" for t_s, text in zip(since_s, texts, strict=True)]
        index = self._index([tick.woke_ns for tick in changed], [tick.index for tick in changed])
        columns = rr.TextLog.columns(text=lines, level=levels, color=colors)
        self._recording.stream.send_columns(EVENTS, index, columns, strict=True)

    def _tick_indexes_at(self, stamps_ns: list[int], ticks: list[Tick]) -> list[int]:
        """Index of the last tick before each stamp, as far as this batch shows."""
        known = [tick for tick in (self._last_tick, *ticks) if tick is not None]
        if not known:
            return [0] * len(stamps_ns)
        after = np.searchsorted([tick.woke_ns for tick in known], stamps_ns, side="right")
        return [known[max(position - 1, 0)].index for position in after]

    def _index(self, stamps_ns: list[int], tick_indexes: list[int]) -> list[rr.TimeColumn]:
        since_ns = np.array(stamps_ns) - (self._origin_ns or 0)
        return [
            rr.TimeColumn("time", duration=since_ns.astype("timedelta64[ns]")),
            rr.TimeColumn("tick", sequence=tick_indexes),
        ]

    def _send(self, plot: _Plot, index: list[rr.TimeColumn], values: NDArray[Any]) -> None:
        columns = rr.Scalars.columns(scalars=values.reshape(-1, len(plot.series)))
        self._recording.stream.send_columns(plot.path, index, columns, strict=True)


class _Periods:
    """Differences of a series of stamps that comes in batches."""

    def __init__(self) -> None:
        self._last_ns: int | None = None

    def extend(self, stamps_ns: list[int]) -> FloatColumn:
        """Periods in ms; a gap for the very first stamp."""
        first_ns = math.nan if self._last_ns is None else stamps_ns[0] - self._last_ns
        period_ms = _ms([first_ns, *np.diff(stamps_ns)])
        self._last_ns = stamps_ns[-1]
        return period_ms


def _ms(values_ns: Sequence[float | None] | Sequence[tuple[float | None, ...]]) -> FloatColumn:
    """Milliseconds; a missing value becomes NaN, which breaks its line."""
    return np.array(values_ns, dtype=np.float64) / NS_PER_MS


def _ages_ns(tick: Tick) -> tuple[int | None, int | None]:
    feature_ns, state = tick.feature_captured_ns, tick.state
    feature_age_ns = None if feature_ns is None else tick.sent_ns - feature_ns
    return feature_age_ns, None if state is None else tick.sent_ns - state.attitude_ns


def _lateness_ns(tick: Tick) -> int | None:
    """Time from the slot to its send; None for sticks sent between two slots, or not at all."""
    return None if tick.trace is None or not tick.is_slot else max(0, tick.sent_ns - tick.due_ns)


def _stages(tick: Tick, action: ActionKind) -> tuple[Action, ...]:
    """The series of an action's plots in their order, each with all four numbers."""
    echo: Action = (tick.rc_sticks if action == "sticks" else None) or _STICKS_GAP
    trace, sent = tick.trace, tick.sent or _STICKS_GAP
    if trace is None:
        return (echo, *(_STICKS_GAP,) * 4, sent)
    return echo, trace.raw, trace.clipped, trace.slewed, trace.smoothed, sent


def _changes(before: Tick | None, now: Tick) -> Iterator[tuple[str, str, _Rgb]]:
    """Text, level and colour of everything in this tick that is new to the user."""
    if before is None or before.activity != now.activity:
        if now.release_reason is None:
            yield now.activity, "INFO", _GREEN if now.trace else _WHITE
        else:
            yield now.activity, "WARN", _ORANGE
    if now.mode is not None and (before is None or before.mode != now.mode):
        yield f"mode {now.mode}", "INFO", _WHITE
    if before is None or before.armed != now.armed:
        yield "armed" if now.armed else "disarmed", "INFO", _WHITE
    for text in now.texts:
        yield text, "INFO", _WHITE


def _jpeg(rgb: ImageArray) -> bytes:
    height, width = rgb.shape[:2]
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    if width > MAX_IMAGE_WIDTH:
        size = (MAX_IMAGE_WIDTH, max(1, round(height * MAX_IMAGE_WIDTH / width)))
        bgr = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return encoded.tobytes()
