"""Plots of the viewer and their places on its two pages, ``Flight`` and ``Timing``.

No plot has a legend, which would cover its data: the title names each line and its colour.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, TypeAlias

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TimelineColumn

from mavbridge.core.course import CourseGate
from mavbridge.core.records import FloatArray, Position
from mavbridge.core.vehicle import ACTION_CLASSES, Action, ActionKind
from policy.contract import Contract

EVENTS = "events"
SCENE = "scene"
CHASE = f"{SCENE}/chase"
"""Level axes that move and turn with the vehicle, for an eye that follows it."""
VEHICLE = f"{CHASE}/vehicle"
"""Axes within ``CHASE`` that also lean with the vehicle."""
PATH = f"{SCENE}/path"
PLANNED_PATH = f"{SCENE}/planned"
PLAN_LANES = 2
"""Planned actions overlap in time: a line would join neighbours in one entity."""
PLAN_TAIL_S = 3.0
"""Time before the cursor for which the scene shows planned paths."""
ORIGIN = Position(0.0, 0.0, 0.0)
"""Drawn position of a vehicle that reports none."""
UP = (0.0, 0.0, -1.0)
NEAR_EYE_M, FAR_EYE_M = (-3.0, 0.8, -1.3), (-16.0, 5.0, -11.0)
"""Positions of following eyes: behind, to the right of and above the vehicle."""

Rgb: TypeAlias = tuple[int, int, int]
# All of them are readable on the dark and the light background that a browser can ask for.
BLUE, ORANGE, GREEN, RED = (86, 180, 233), (240, 160, 40), (60, 200, 140), (235, 80, 70)
PINK, GREY = (225, 120, 180), (145, 145, 145)
DARK_BLUE = (45, 95, 135)


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewedFlight:
    """Facts that the viewer gets before a flight begins."""

    vision_hz: float
    chunk_hz: float
    stick_hz: float
    contract: Contract = field(default_factory=Contract)
    """Kind of the actions, frame of the states, names of the cameras."""
    max_state_age_ns: int | None = None
    """Age limits when a stick is sent; None: nothing is flown by them."""
    max_feature_age_ns: int | None = None
    to_ned: Callable[[FloatArray], tuple[Action, ...]] | None = None
    """Converts actions [horizon, 4] of a solve to NED and FRD; None: no plan is shown."""
    gates: tuple[CourseGate, ...] = ()


class Series(NamedTuple):
    """One line of a plot."""

    name: str
    color: Rgb
    width: float = 1.5


class Plot(NamedTuple):
    """One entity: series that share their stamps."""

    path: str
    title: str
    series: tuple[Series, ...]


def _band(path: str, title: str, bound: str) -> Plot:
    """Return a plot of a quantity that jumps between values: its spread over short windows."""
    series = (
        Series("least", DARK_BLUE),
        Series("most", DARK_BLUE),
        Series("median", BLUE, width=2),
        Series(bound, RED),
    )
    return Plot(path, f"{title} [ms], red: {bound}", series)


IMAGE_AGE = _band("age/image", "Image age when sent", "limit")
ATTITUDE_AGE = _band("age/attitude", "Attitude age when sent", "limit")
LATENESS = _band("jitter/sticks", "Jitter: sticks after their slot", "missed")
CHUNK_PERIOD = _band("period/chunk", "Time between chunks", "target")
PREDICT = _band("compute/chunk", "Time to compute a chunk", "target period")
VISION_JITTER = _band("jitter/vision", "Jitter: images off their period", "period")
VISION_PERIOD = _band("period/vision", "Time between images", "target")
ENCODE = _band("compute/vision", "Time to encode an image", "target period")
BANDS = (
    *(IMAGE_AGE, ATTITUDE_AGE, LATENESS, CHUNK_PERIOD, PREDICT),
    *(VISION_JITTER, VISION_PERIOD, ENCODE),
)
_COUNTS = (Series("0.1 % of all", RED), Series("count", BLUE, width=2))
MISSED = Plot("missed/sticks", "Missed slots since the start, red: 0.1 % of all", _COUNTS)
DROPPED = Plot("missed/vision", "Dropped images since the start, red: 0.1 % of all", _COUNTS)
SPEED = Plot(
    "motion/speed",
    "Speed [m/s]: blue horizontal, green climb",
    (Series("horizontal", BLUE, 2), Series("climb", GREEN, 2)),
)
HEIGHT = Plot("motion/height", "Height above the origin [m]", (Series("height", BLUE, 2),))
PLOTS = (*BANDS, MISSED, DROPPED, SPEED, HEIGHT)

ACTION_SERIES = (
    Series("vehicle's echo", GREEN, width=4),  # first, so that the others are drawn on top
    Series("policy", PINK),
    Series("sent", BLUE),
)
_UNITS = {"radps": "rad/s", "rad": "rad", "mps": "m/s"}
_PLAN_SERIES = (Series("planned", ORANGE, width=1),)


def action_plots(action: ActionKind) -> tuple[Plot, ...]:
    """Return one plot for each of the four numbers of an action of this kind."""
    key = ": blue sent, pink policy, orange plan" + (", green echo" if action == "sticks" else "")
    return tuple(
        Plot(f"{action}/{name}", f"{action_title(name)}{key}", ACTION_SERIES)
        for name in ACTION_CLASSES[action]._fields
    )


def action_title(name: str) -> str:
    """Convert a field name to a title: ``yaw_rate_radps`` -> ``Yaw rate [rad/s]``."""
    stem, _, unit = name.rpartition("_")
    if unit not in _UNITS:
        return name.capitalize()
    return f"{stem.replace('_', ' ').capitalize()} [{_UNITS[unit]}]"


def plan_plots(action: ActionKind) -> tuple[tuple[Plot, ...], ...]:
    """Return, for each lane, the planned course of each of the four numbers."""
    return tuple(
        tuple(Plot(f"{plot.path}/plan/{lane}", "", _PLAN_SERIES) for plot in action_plots(action))
        for lane in range(PLAN_LANES)
    )


def camera_paths(cameras: tuple[str, ...]) -> tuple[str, ...]:
    """Return each camera's entity, below the vehicle so that its images hang in the scene."""
    return tuple(f"{VEHICLE}/{name}" for name in cameras)


def styles(action: ActionKind) -> tuple[tuple[str, rr.SeriesLines], ...]:
    """Return names, colours and widths of all lines, by entity."""
    plans = [plot for lane in plan_plots(action) for plot in lane]
    return tuple((plot.path, _style(plot)) for plot in (*PLOTS, *action_plots(action), *plans))


def _style(plot: Plot) -> rr.SeriesLines:
    return rr.SeriesLines(
        names=[series.name for series in plot.series],
        colors=[series.color for series in plot.series],
        widths=[series.width for series in plot.series],
        aggregation_policy="MinMax",  # zoomed out: averages would hide stalls
    )


def flight_blueprint(flight: ViewedFlight) -> rrb.Blueprint:
    """Return the initial layout: the vehicle's position and commands, then the timing."""
    contract = flight.contract
    cameras = [
        rrb.Spatial2DView(
            origin=path, name=f"Camera {name}" if len(contract.cameras) > 1 else "Camera"
        )
        for path, name in zip(camera_paths(contract.cameras), contract.cameras, strict=True)
    ]
    place = rrb.Vertical(
        _scenes(flight.gates),
        rrb.Horizontal(rrb.Horizontal(*cameras), _events(), column_shares=[2, 3]),
        row_shares=[3, 2],
    )
    motion = rrb.Vertical(
        *(_time_series(plot) for plot in (SPEED, HEIGHT)),
        *(
            _time_series(plot, value_range=(-1.1, 1.1) if contract.action == "sticks" else None)
            for plot in action_plots(contract.action)
        ),
        row_shares=[5, 5, 4, 4, 4, 4],
    )
    return rrb.Blueprint(
        rrb.Tabs(
            rrb.Horizontal(place, motion, column_shares=[3, 2], name="Flight"),
            timing_page(),
            active_tab=0,
        ),
        rrb.TimePanel(state="collapsed", timeline="time"),
        collapse_panels=True,
    )


def _scenes(gates: Sequence[CourseGate]) -> rrb.Horizontal:
    """Return two scenes: the path (whole with known gates, else from afar), the near vehicle."""
    until_now = rrb.VisibleTimeRange(
        "time", start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative()
    )
    lately = rrb.VisibleTimeRange(
        "time",
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-PLAN_TAIL_S),
        end=rrb.TimeRangeBoundary.cursor_relative(),
    )
    trails: dict[rr.EntityPath | str, rrb.VisibleTimeRanges] = {
        PATH: rrb.VisibleTimeRanges(until_now),
        PLANNED_PATH: rrb.VisibleTimeRanges(lately),
    }

    def scene(name: str, origin: str, eye: rrb.EyeControls3D) -> rrb.Spatial3DView:
        return rrb.Spatial3DView(
            name=name, origin=origin, contents=[f"/{SCENE}/**"], overrides=trails, eye_controls=eye
        )

    name = "Path: blue policy, grey others, orange plan"
    return rrb.Horizontal(
        scene(name, SCENE, _overlooking(gates))
        if gates
        else scene(name, CHASE, _behind(FAR_EYE_M)),
        scene("From behind: red = front", CHASE, _behind(NEAR_EYE_M)),
    )


def _overlooking(gates: Sequence[CourseGate]) -> rrb.EyeControls3D:
    """Return an eye behind and above the start that sees all gates."""
    centers_m = np.array([ORIGIN, *(gate.center_ned_m for gate in gates)])
    middle_m = (centers_m.min(axis=0) + centers_m.max(axis=0)) / 2
    reach_m = float(np.linalg.norm(centers_m - middle_m, axis=1).max())
    first_m = centers_m[1] / max(float(np.linalg.norm(centers_m[1])), 1e-6)
    position_m = middle_m - 1.6 * reach_m * first_m + np.array([0.0, 0.0, -0.9 * reach_m])
    return rrb.EyeControls3D(position=position_m, look_target=middle_m, eye_up=UP)


def _behind(position_m: tuple[float, float, float]) -> rrb.EyeControls3D:
    return rrb.EyeControls3D(position=position_m, look_target=(1.0, 0.0, 0.0), eye_up=UP)


def timing_page() -> rrb.Horizontal:
    """Return the page ``Timing``: every age, period and count beside its limit, and the events."""
    columns = (
        (IMAGE_AGE, ATTITUDE_AGE),
        (LATENESS, CHUNK_PERIOD, PREDICT, MISSED),
        (VISION_JITTER, VISION_PERIOD, ENCODE, DROPPED),
    )
    first, *others = ([_time_series(plot) for plot in column] for column in columns)
    return rrb.Horizontal(
        rrb.Vertical(*first, _events()),
        *(rrb.Vertical(*views) for views in others),
        name="Timing: median, least and most of each quarter of a second",
    )


def _events() -> rrb.TextLogView:
    """Return a list of events that shows only the text, which begins with the time; the viewer's
    own column of times is too narrow."""
    columns = rrb.TextLogColumns(
        timeline_columns=[TimelineColumn("time", visible=False)], text_log_columns=["Body"]
    )
    return rrb.TextLogView(origin=EVENTS, name="Events", columns=columns)


def _time_series(plot: Plot, value_range: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(
        name=plot.title,
        contents=[f"/{plot.path}/**"],
        axis_x=rrb.TimeAxis(link="LinkToGlobal"),
        axis_y=None if value_range is None else rrb.ScalarAxis(range=value_range),
        plot_legend=rrb.PlotLegend(visible=False),
    )
