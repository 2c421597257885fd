"""Flights are written to a file and read back with Rerun's own reader."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from helpers.factories import (
    START_NS,
    make_released_tick,
    make_solve,
    make_state,
    make_tick,
    make_vision_tick,
)
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.course import CourseGate
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Observed, Position
from mavbridge.core.vehicle import ActionKind, ActionTrace, Sticks
from mavbridge.flight.history import ActionFrame
from mavbridge.observe.viewer import EVENT_CHARACTERS, RerunView, layout
from mavbridge.observe.viewer_layout import ViewedFlight, flight_blueprint, styles
from policy.contract import Contract
from policy.motion.stick_loop import GRAVITY_MPS2

CAMERA = "/scene/chase/vehicle/front"


class Recording:
    """What a .rrd file holds, by entity."""

    def __init__(self, path: Path) -> None:
        self.columns: dict[str, dict[str, list[Any]]] = {}
        self.static: dict[str, dict[str, list[Any]]] = {}
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            kept = self.static if chunk.is_static else self.columns
            entity = kept.setdefault(chunk.entity_path, {})
            for name, column in zip(batch.schema.names, batch.columns, strict=True):
                values = column.cast("int64").to_pylist() if name == "time" else column.to_pylist()
                entity.setdefault(name, []).extend(values)

    def rows(self, path: str) -> list[list[float]]:
        """All rows of an entity but the gaps at both ends of the timeline."""
        return [list(row) for row in self.columns[f"/{path}"]["Scalars:scalars"]][1:-1]

    def values(self, path: str, series: int = 0) -> list[float]:
        return [row[series] for row in self.rows(path)]

    def times_ms(self, path: str) -> list[float]:
        return [stamp_ns / NS_PER_MS for stamp_ns in self.columns[path]["time"]]

    def strips(self, path: str) -> list[list[list[float]]]:
        rows = self.columns[path]["LineStrips3D:strips"]
        return [[list(point) for point in strip] for row in rows for strip in row]

    def image(self, path: str = CAMERA) -> np.ndarray[Any, Any]:
        """The first image of an entity, as BGR."""
        encoded = np.array(self.columns[path]["EncodedImage:blob"][0][0], dtype=np.uint8)
        return cv2.imdecode(encoded, cv2.IMREAD_COLOR)

    def rotated(self, path: str, vector: list[float]) -> list[float]:
        """What the first rotation of an entity makes of a vector."""
        x, y, z, w = self.columns[path]["Transform3D:quaternion"][0][0]
        axis, v = np.array([x, y, z]), np.array(vector)
        return list(v + 2 * np.cross(axis, np.cross(axis, v) + w * v))


def viewed(contract: Contract | None = None, gates: tuple[CourseGate, ...] = ()) -> ViewedFlight:
    """A flight at the rates of the factories' events."""
    contract = contract or Contract()
    return ViewedFlight(
        vision_hz=30.0,
        chunk_hz=100.0,
        stick_hz=100.0,
        contract=contract,
        max_state_age_ns=100_000_000,
        max_feature_age_ns=300_000_000,
        to_ned=ActionFrame(contract).to_guard,
        gates=gates,
    )


@pytest.fixture
def show(tmp_path: Path) -> Callable[..., Recording]:
    """Shows batches of events of a flight."""

    def run(*batches: list[Observed], is_live: bool = True, **facts: Any) -> Recording:
        path = tmp_path / "flight.rrd"
        view = RerunView(str(path), viewed(**facts), is_live=is_live)
        for batch in batches:
            view.consume(batch)
        view.close()
        return Recording(path)

    return run


Show = Callable[..., Recording]


def test_ages_are_spread_over_windows_in_milliseconds_beside_their_limits(show: Show) -> None:
    ticks = [make_tick(index) for index in range(30)]
    ticks[3] = make_tick(3, feature_captured_ns=ticks[3].sent_ns - 60 * NS_PER_MS)
    seen = show(ticks[:10], ticks[10:])
    # least, most, median, limit
    assert seen.rows("age/image") == [[40, 60, 40, 300], [40, 40, 40, 300]]
    assert seen.rows("age/attitude") == [[3, 3, 3, 100]] * 2
    assert seen.times_ms("/age/image")[1:-1] == [242, 292]  # the last value of each window


def test_what_was_not_measured_is_a_gap_and_all_plots_begin_and_end_together(show: Show) -> None:
    """As after a fault; nor is a chunk shown that nobody flies."""
    blind = {"feature_captured_ns": None, "state": None, "rc_sticks": None}
    seen = show([make_released_tick(0, **blind), make_solve()], [make_released_tick(500, **blind)])
    for path in ("age/image", "age/attitude", "compute/chunk", "period/chunk", "jitter/sticks"):
        assert seen.rows(path) == [], path
    for axis in Sticks._fields:
        assert all(math.isnan(seen.values(f"sticks/{axis}", series)[0]) for series in range(3))
    assert "/sticks/throttle/plan/0" not in seen.columns
    plots = (*layout.PLOTS, *layout.action_plots("sticks"))
    ends_ms = {(times[0], times[-1]) for plot in plots if (times := seen.times_ms(f"/{plot.path}"))}
    assert ends_ms == {(0, 5002)}


def test_chunks_and_missed_slots_go_on_across_batches_not_across_releases(show: Show) -> None:
    repeated = make_tick(2, chunk_serial=1, chunk_computed_ns=make_tick(1).chunk_computed_ns)
    seen = show(
        [make_tick(0), make_tick(1), repeated],
        [make_tick(4, missed_slots=3, chunk_serial=3)],  # chunk 2 was overtaken
        [make_released_tick(20), make_tick(21)],
    )
    assert seen.rows("period/chunk") == [[10, 15, 12.5, 10]]
    assert seen.rows("compute/chunk") == [[2, 2, 2, 10]]
    assert seen.values("missed/sticks", 1) == [0, 3, 3]
    assert seen.values("missed/sticks", 0) == pytest.approx([0.002, 0.004, 0.021])  # allowed


def test_images_hang_at_their_camera_with_their_exposure_and_the_first_is_timed(
    show: Show,
) -> None:
    rgb = np.zeros((48, 64, 3), dtype=np.uint8)
    rgb[:, :, 0] = 200  # red
    first, second, late = (make_vision_tick(number, rgb=rgb) for number in (1, 2, 4))
    below, contract = make_vision_tick(2, camera=1), Contract(cameras=("front", "down"))
    batches = [make_tick(0), first, second, below], [late]
    recorded = show(*batches, contract=contract, is_live=False)  # no such figures, only gaps
    assert recorded.rows("compute/vision") == recorded.rows("missed/vision") == []
    seen = show(*batches, contract=contract)
    assert seen.rows("period/vision") == recorded.rows("period/vision")
    assert seen.rows("period/vision")[0] == pytest.approx([33.333, 66.667, 50, 33.333], abs=0.01)
    assert seen.rows("jitter/vision")[0] == pytest.approx([0, 33.333, 16.667, 33.333], abs=0.01)
    assert seen.rows("compute/vision") == [pytest.approx([20, 20, 20, 33.333], abs=0.01)]
    assert seen.values("missed/vision", 1) == [0, 0]
    down = CAMERA.replace("front", "down")
    assert seen.times_ms(CAMERA) == pytest.approx([0, 33.333, 100], abs=0.001)
    assert seen.times_ms(down) == pytest.approx([33.333], abs=0.001)
    axes = [list(seen.static[path]["Pinhole:camera_xyz"][0][0]) for path in (CAMERA, down)]
    assert axes[0] != axes[1]
    assert seen.image().shape == (48, 64, 3)
    assert seen.image()[24, 32] == pytest.approx([0, 0, 200], abs=6)


def test_depth_is_shown_brighter_the_nearer_and_unknown_as_black(show: Show) -> None:
    depth = np.full((48, 64), 2000, np.uint16)
    depth[:, 32:], depth[:, 48:] = 8000, 0
    seen = show([make_tick(0), make_vision_tick(1, rgb=depth)])
    near, far, unknown = seen.image()[24, [8, 40, 60], 0].astype(int)
    assert near > far + 50 > unknown + 80
    assert unknown < 10


def test_every_stick_has_its_series_and_events_are_transitions_across_batches(show: Show) -> None:
    stages = [
        Sticks(throttle=k + 0.125, yaw=k + 0.25, pitch=k + 0.5, roll=k + 0.75) for k in range(6)
    ]
    echo, raw, clipped, slewed, smoothed, sent = stages
    trace = ActionTrace(raw=raw, clipped=clipped, slewed=slewed, smoothed=smoothed)
    text = "RC_OVERRIDE_TIME is 3: " + "the vehicle would hold its sticks, " * 4 + "or so"
    seen = show(
        [make_released_tick(0, armed=False), make_released_tick(1, armed=False)],
        [make_tick(2, trace=trace, sent=sent, rc_sticks=echo), make_tick(3, texts=(text,))],
        [make_released_tick(4, because(Code.LANDED), mode="LAND")],
    )
    for axis, name in enumerate(Sticks._fields):
        shown = [seen.values(f"sticks/{name}", series)[2] for series in range(3)]
        assert shown == [stage[axis] for stage in (echo, raw, sent)]
    names = seen.static["/sticks/roll"]["SeriesLines:names"][0]
    assert names == ["vehicle's echo", "policy", "sent"]
    lines = [row[0] for row in seen.columns["/events"]["TextLog:text"]]
    assert [line[10:] for line in (*lines[:5], *lines[-2:])] == [
        "RELEASED: no image feature yet",
        "mode ALT_HOLD",
        "disarmed",
        "FLYING: the policy has control",
        "armed",
        "RELEASED: the vehicle has landed",
        "mode LAND",
    ]
    assert seen.times_ms("/events")[:6] == [0, 0, 0, 20, 20, 30]
    assert max(map(len, lines)) <= EVENT_CHARACTERS + 10
    assert " ".join(line[10:] for line in lines[5:-2]) == text


def test_an_older_file_is_replaced_only_once_the_vehicle_is_heard(tmp_path: Path) -> None:
    path = tmp_path / "flight.rrd"
    path.write_text("an older flight")
    for unheard in (make_released_tick(0, mode=None), make_vision_tick(1)):
        view = RerunView(str(path), viewed(), is_live=True)
        view.consume([unheard])
        view.close()
        assert path.read_text() == "an older flight"
    view = RerunView(str(path), viewed(), is_live=True)
    view.consume([make_tick(0)])
    view.close()
    assert Recording(path).rows("age/attitude")


def turned(*, yaw_rad: float, roll_rad: float) -> tuple[float, ...]:
    (yaw_c, yaw_s), (c, s) = ((math.cos(a / 2), math.sin(a / 2)) for a in (yaw_rad, roll_rad))
    return (yaw_c * c, yaw_c * s, yaw_s * s, yaw_s * c)


@pytest.mark.parametrize(
    ("frame", "quaternion", "velocity", "place", "heading_rad", "lean_rad"),
    [
        ("ned_frd", turned(yaw_rad=0.8, roll_rad=0.5), (0.0, 3.0, -1.0), None, 0.8, 0.5),
        ("enu_flu", (1, 0, 0, 0), (3.0, 0.0, 1.0), Position(4.0, 5.0, -6.0), math.pi / 2, 0.0),
    ],
)
def test_the_pose_is_shown_in_ned_whatever_the_contracts_frame(
    show: Show,
    frame: Any,
    quaternion: tuple[float, ...],
    velocity: tuple[float, ...],
    place: Position | None,
    heading_rad: float,
    lean_rad: float,
) -> None:
    """The heading moves the eye, the lean is the vehicle's."""
    values = np.array((*velocity, *quaternion, *(0.0,) * 6), dtype=np.float32)
    tick = make_tick(0, state=make_state(START_NS, values=values), position_ned_m=place)
    seen = show([tick], contract=Contract(state_frame=frame))
    north, east = math.cos(heading_rad), math.sin(heading_rad)
    assert seen.rotated("/scene/chase", [1, 0, 0]) == pytest.approx([north, east, 0], abs=1e-3)
    right, down = math.cos(lean_rad), math.sin(lean_rad)
    vehicle = seen.rotated("/scene/chase/vehicle", [0, 1, 0])
    assert vehicle == pytest.approx([0, right, down], abs=1e-3)
    translation = list(seen.columns["/scene/chase"]["Transform3D:translation"][0][0])
    assert translation == list(place or (0, 0, 0))
    assert seen.rows("motion/speed")[0] == pytest.approx([3, 1])
    height_m = -place.down if place else math.nan
    assert seen.values("motion/height") == pytest.approx([height_m], nan_ok=True)


def test_the_path_goes_on_from_batch_to_batch_among_the_gates(show: Show) -> None:
    gate = CourseGate(Position(10.0, 2.0, -3.0), math.pi / 2, 2.0)  # flown through towards east
    ticks = [make_tick(3 * k, position_ned_m=Position(float(k), 0.0, 0.0)) for k in range(5)]
    seen = show(ticks[:3], ticks[3:], gates=(gate,))
    assert seen.strips("/scene/path") == [
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        [[2, 0, 0], [3, 0, 0], [4, 0, 0]],
    ]
    corners = [list(point) for point in seen.static["/scene/gates"]["LineStrips3D:strips"][0][0]]
    assert np.allclose(sorted(corners[:4]), [[9, 2, -4], [9, 2, -2], [11, 2, -4], [11, 2, -2]])
    assert seen.static["/scene/gates"]["LineStrips3D:labels"] == [["1"]]


def test_some_chunks_are_shown_over_the_time_that_they_are_for(show: Show) -> None:
    actions = np.array([[[0.1 * k, 0.0, 0.0, 0.0] for k in range(8)]], np.float32)
    solves = [make_solve(index, actions=actions) for index in range(100)]
    seen = show([*(make_tick(index) for index in range(100)), *solves])
    for lane, begins_ms in ((0, 0), (1, 230)):
        path = f"/sticks/throttle/plan/{lane}"
        stamps_ms = seen.times_ms(path)
        assert stamps_ms[:9] == [begins_ms + 50 * step for step in range(9)]
        assert stamps_ms == sorted(stamps_ms)
        values = [row[0] for row in seen.columns[path]["Scalars:scalars"]]
        assert values[:8] == pytest.approx([0.1 * k for k in range(8)])
        assert math.isnan(values[8])


@pytest.mark.parametrize("action", get_args(ActionKind))
def test_every_plot_is_in_the_blueprint(action: ActionKind) -> None:
    def contents(node: Any) -> Iterator[str]:
        found = getattr(node, "contents", ())
        for child in found if isinstance(found, list | tuple) else ():
            yield from [str(child)] if isinstance(child, str) else contents(child)

    blueprint = flight_blueprint(viewed(Contract(action=action)))
    shown = [str(text).strip("/*") for text in contents(blueprint.root_container)]
    for path, _ in styles(action):
        assert any(path == entry or path.startswith(f"{entry}/") for entry in shown), path


@pytest.mark.parametrize(
    ("action", "numbers", "moved"),
    [
        ("velocity", (2.0, 0.0, -1.0, 0.0), (2.0, 0.0, -1.0)),
        # Half of the full climb, level.
        ("sticks", (0.5, 0.0, 0.0, 0.0), (0.0, 0.0, -0.5 * Contract().full_climb_mps)),
    ],
)
def test_a_chunk_becomes_the_path_of_what_its_actions_mean(
    show: Show, action: Any, numbers: tuple[float, ...], moved: tuple[float, ...]
) -> None:
    values = np.array((*moved, 1, 0, 0, 0, 0, 0, 0, 0, 0, -GRAVITY_MPS2), np.float32)
    solve = make_solve(
        state=make_state(START_NS, values=values), actions=np.array([[numbers] * 20], np.float32)
    )
    contract = Contract(action=action, throttle_dead_zone=0.0)
    place = Position(1.0, 2.0, -3.0)
    seen = show([make_tick(0, position_ned_m=place), solve], contract=contract)
    (path,) = seen.strips("/scene/planned")
    assert path[0] == list(place)
    after_a_second = [end - start for start, end in zip(path[0], path[-1], strict=True)]
    assert after_a_second == pytest.approx(moved, rel=0.06, abs=1e-6)
