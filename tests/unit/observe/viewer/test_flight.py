"""Flights are written to a file and read back with Rerun's own reader."""

import math
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import pytest
from rerun.chunk import RrdReader

from helpers.factories import START_NS, make_released_tick, make_state, make_tick, make_vision_tick
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.course import CourseGate
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import Observed, Position, Solve, VehicleState
from mavbridge.core.vehicle import ActionKind, ActionTrace, Sticks
from mavbridge.flight.action_frames import action_frame
from mavbridge.observe.viewer import layout
from mavbridge.observe.viewer.flight import EVENT_CHARACTERS, RerunView
from mavbridge.observe.viewer.layout import ViewedFlight, flight_blueprint, styles
from policy.contract import Contract
from policy.motion.stick_loop import GRAVITY_MPS2

CAMERA = "/scene/chase/vehicle/front"


class Recording:
    """What a .rrd file holds, by entity."""

    def __init__(self, path: Path) -> None:
        self.reader = RrdReader(path)
        self.columns: dict[str, dict[str, list[Any]]] = {}
        self.static: dict[str, dict[str, list[Any]]] = {}
        for chunk in self.reader.stream():
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
        return [stamp_ns / NS_PER_MS for stamp_ns in self.columns[f"/{path}"]["time"]][1:-1]

    def events(self) -> list[str]:
        return [row[0] for row in self.columns["/events"]["TextLog:text"]]


def viewed(contract: Contract | None = None, **changes: Any) -> ViewedFlight:
    """A flight at the rates of the factories' events."""
    contract = contract or Contract()
    facts: dict[str, Any] = {
        "vision_hz": 30.0,
        "chunk_hz": 100.0,
        "stick_hz": 100.0,
        "contract": contract,
        "max_state_age_s": 0.1,
        "max_feature_age_s": 0.3,
        "to_ned": action_frame(contract).to_guard,
    }
    return ViewedFlight(**(facts | changes))


def show(path: Path, *batches: list[Observed], flight: ViewedFlight | None = None) -> Recording:
    view = RerunView(str(path), flight or viewed())
    for batch in batches:
        view.consume(batch)
    view.close()
    return Recording(path)


@pytest.fixture
def rrd(tmp_path: Path) -> Path:
    return tmp_path / "flight.rrd"


LEAST, MOST, MEDIAN, BOUND = range(4)


def test_ages_are_spread_over_windows_in_milliseconds_beside_their_limits(rrd: Path) -> None:
    late_ns = 60 * NS_PER_MS
    ticks = [make_tick(index) for index in range(30)]
    ticks[3] = make_tick(3, feature_captured_ns=ticks[3].sent_ns - late_ns)
    seen = show(rrd, ticks[:10], ticks[10:])
    assert seen.rows("age/image") == [[40, 60, 40, 300], [40, 40, 40, 300]]
    assert seen.rows("age/attitude") == [[3, 3, 3, 100]] * 2
    assert seen.times_ms("age/image") == [242, 292]  # the last value of each window


def test_what_was_not_measured_is_a_gap_never_a_zero(rrd: Path) -> None:
    blind = make_released_tick(
        0, feature_captured_ns=None, state=None, rc_channels_us=(), rc_sticks=None
    )
    seen = show(rrd, [blind])
    for path in ("age/image", "age/attitude", "compute/chunk", "period/chunk", "jitter/sticks"):
        assert seen.rows(path) == [], path
    for axis in Sticks._fields:
        assert all(math.isnan(seen.values(f"sticks/{axis}", series)[0]) for series in range(3))
    assert all(math.isnan(seen.values("rc", channel)[0]) for channel in range(4))


def test_all_plots_begin_and_end_together(rrd: Path) -> None:
    """As after a fault, when only the vehicle's echo continues."""
    seen = show(rrd, [make_tick(0)], [make_released_tick(500, state=None)])
    plots = (*layout.PLOTS, *layout.action_plots("sticks"))
    times_ns = [seen.columns[f"/{plot.path}"]["time"] for plot in plots]
    assert {min(times) for times in times_ns} == {0}
    assert len({max(times) for times in times_ns}) == 1


def test_periods_of_chunks_go_on_across_batches_and_not_across_releases(rrd: Path) -> None:
    repeated = make_tick(2, chunk_serial=1, chunk_computed_ns=make_tick(1).chunk_computed_ns)
    released, again = make_released_tick(20), make_tick(21)
    seen = show(rrd, [make_tick(0), make_tick(1), repeated], [make_tick(4)], [released, again])
    assert seen.rows("period/chunk") == [[10, 30, 20, 10]]
    assert seen.rows("compute/chunk") == [[2, 2, 2, 10]]


def test_missed_slots_add_up_from_zero_beside_what_is_allowed(rrd: Path) -> None:
    seen = show(rrd, [make_tick(0)], [make_tick(4, missed_slots=3)], [make_tick(100)])
    assert seen.values("missed/sticks", 1) == [0, 3, 3]
    assert seen.values("missed/sticks", 0) == pytest.approx([0, 0.004, 0.1])


def test_images_are_timed_against_their_period(rrd: Path) -> None:
    frames = [make_vision_tick(number) for number in (1, 2)]
    late = make_vision_tick(4)
    seen = show(rrd, [make_tick(0), *frames], [late])
    assert seen.rows("period/vision")[0] == pytest.approx([33.333, 66.667, 50, 33.333], abs=0.01)
    assert seen.rows("jitter/vision")[0] == pytest.approx([0, 33.333, 16.667, 33.333], abs=0.01)
    assert seen.rows("compute/vision")[0] == pytest.approx([20, 20, 20, 33.333], abs=0.01)


def test_what_becomes_of_every_stick_has_its_series(rrd: Path) -> None:
    stages = [
        Sticks(throttle=k + 0.125, yaw=k + 0.25, pitch=k + 0.5, roll=k + 0.75) for k in range(6)
    ]
    echo, raw, clipped, slewed, smoothed, sent = stages
    trace = ActionTrace(raw=raw, clipped=clipped, slewed=slewed, smoothed=smoothed)
    seen = show(rrd, [make_tick(0, trace=trace, sent=sent, rc_sticks=echo)])
    for axis, name in enumerate(Sticks._fields):
        shown = [seen.values(f"sticks/{name}", series)[0] for series in range(3)]
        assert shown == [stage[axis] for stage in (echo, raw, sent)]
    names = seen.static["/sticks/roll"]["SeriesLines:names"][0]
    assert names == ["vehicle's echo", "policy", "sent"]


def test_events_are_transitions_across_batches(rrd: Path) -> None:
    seen = show(
        rrd,
        [make_released_tick(0, armed=False), make_released_tick(1, armed=False)],
        [make_tick(2), make_tick(3)],
        [make_released_tick(4, because(Code.LANDED), mode="LAND")],
    )
    assert [text.split(maxsplit=2)[2] for text in seen.events()] == [
        "RELEASED: no image feature yet",
        "mode ALT_HOLD",
        "disarmed",
        "FLYING: the policy has control",
        "armed",
        "RELEASED: the vehicle has landed",
        "mode LAND",
    ]
    stamps_ms = [stamp_ns // NS_PER_MS for stamp_ns in seen.columns["/events"]["time"]]
    assert stamps_ms == [0, 0, 0, 20, 20, 40, 40]


def test_a_long_text_goes_on_in_the_next_line(rrd: Path) -> None:
    text = "RC_OVERRIDE_TIME is 3: " + "the vehicle would hold its sticks, " * 4
    seen = show(rrd, [make_tick(0, texts=(text.strip(),))])
    lines = [line for line in seen.events() if "armed" not in line]
    assert max(map(len, lines)) <= EVENT_CHARACTERS + 10
    assert " ".join(line[10:] for line in lines[2:]) == text.strip()


def test_images_are_stamped_with_their_exposure_and_keep_their_colours(rrd: Path) -> None:
    rgb = np.zeros((48, 64, 3), dtype=np.uint8)
    rgb[:, :, 0] = 200  # red
    frames = [make_vision_tick(number, rgb=rgb) for number in (1, 2, 3)]
    seen = show(rrd, [make_tick(0), *frames])
    stamps_ms = [stamp_ns / NS_PER_MS for stamp_ns in seen.columns[CAMERA]["time"]]
    assert stamps_ms == pytest.approx([0, 33.333, 66.667], abs=0.001)
    bgr = image(seen.columns[CAMERA])
    assert bgr.shape == (48, 64, 3)
    assert bgr[24, 32] == pytest.approx([0, 0, 200], abs=6)


def test_depth_is_shown_brighter_the_nearer_and_unknown_as_black(rrd: Path) -> None:
    depth = np.full((48, 64), 2000, np.uint16)
    depth[:, 32:], depth[:, 48:] = 8000, 0
    seen = show(rrd, [make_tick(0), make_vision_tick(1, rgb=depth)])
    near, far, unknown = image(seen.columns[CAMERA])[24, [8, 40, 60], 0].astype(int)
    assert near > far + 50 > unknown + 80
    assert unknown < 10


def image(columns: dict[str, list[Any]]) -> np.ndarray[Any, Any]:
    """The first image of an entity, as BGR."""
    encoded = np.array(columns["EncodedImage:blob"][0][0], dtype=np.uint8)
    bgr = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
    assert bgr is not None
    return bgr


def test_each_camera_hangs_below_the_vehicle_and_the_first_is_timed(rrd: Path) -> None:
    contract = Contract(cameras=("front", "down"))
    frames = [make_vision_tick(1), make_vision_tick(2, camera=1)]
    seen = show(rrd, [make_tick(0), *frames], flight=viewed(contract))
    down = CAMERA.replace("front", "down")
    assert len(seen.columns[CAMERA]["time"]) == len(seen.columns[down]["time"]) == 1
    axes = [list(seen.static[path]["Pinhole:camera_xyz"][0][0]) for path in (CAMERA, down)]
    assert axes[0] != axes[1]
    assert seen.values("missed/vision", 1) == [0]
    assert len(seen.rows("compute/vision")) == 1


def rotated(columns: dict[str, list[Any]], vector: list[float]) -> list[float]:
    """What the first rotation of an entity makes of a vector."""
    x, y, z, w = columns["Transform3D:quaternion"][0][0]
    axis, v = np.array([x, y, z]), np.array(vector)
    turned = v + 2 * np.cross(axis, np.cross(axis, v) + w * v)
    return [round(float(number), 4) for number in turned]


R = math.sqrt(0.5)


@pytest.mark.parametrize(
    ("frame", "quaternion", "velocity"),
    [
        ("ned_frd", (R, 0.0, 0.0, R), (0.0, 3.0, -1.0)),  # heads and flies east, climbs
        ("enu_flu", (1.0, 0.0, 0.0, 0.0), (3.0, 0.0, 1.0)),
    ],
)
def test_the_pose_is_shown_in_ned_whatever_the_contracts_frame(
    rrd: Path, frame: Any, quaternion: tuple[float, ...], velocity: tuple[float, ...]
) -> None:
    values = np.array((*velocity, *quaternion, *(0.0,) * 6), dtype=np.float32)
    place = Position(4.0, 5.0, -6.0)
    tick = make_tick(0, state=make_state(START_NS, values=values), position_ned_m=place)
    seen = show(rrd, [tick], flight=viewed(Contract(state_frame=frame)))
    chase = seen.columns["/scene/chase"]
    assert list(chase["Transform3D:translation"][0][0]) == list(place)
    assert rotated(chase, [1, 0, 0]) == [0, 1, 0]
    assert rotated(seen.columns["/scene/chase/vehicle"], [0, 0, 1]) == [0, 0, 1]
    assert seen.rows("motion/speed")[0] == pytest.approx([3, 1])
    assert seen.rows("motion/height") == [[6]]


def test_heading_moves_the_eye_and_the_lean_is_the_vehicles(rrd: Path) -> None:
    yaw_rad, roll_rad = 0.8, 0.5
    q = (
        math.cos(yaw_rad / 2) * math.cos(roll_rad / 2),
        math.cos(yaw_rad / 2) * math.sin(roll_rad / 2),
        math.sin(yaw_rad / 2) * math.sin(roll_rad / 2),
        math.sin(yaw_rad / 2) * math.cos(roll_rad / 2),
    )
    values = np.array((0, 0, 0, *q, *(0.0,) * 6), dtype=np.float32)
    seen = show(rrd, [make_tick(0, state=make_state(START_NS, values=values))])
    chase, vehicle = seen.columns["/scene/chase"], seen.columns["/scene/chase/vehicle"]
    assert list(chase["Transform3D:translation"][0][0]) == [0, 0, 0]  # no position: at the origin
    assert rotated(chase, [1, 0, 0]) == pytest.approx([math.cos(0.8), math.sin(0.8), 0], abs=1e-3)
    assert rotated(vehicle, [0, 1, 0]) == pytest.approx([0, math.cos(0.5), math.sin(0.5)], abs=1e-3)
    assert math.isnan(seen.values("motion/height")[0])


def strips(seen: Recording, path: str) -> list[list[list[float]]]:
    rows = seen.columns[f"/{path}"]["LineStrips3D:strips"]
    return [[list(point) for point in strip] for row in rows for strip in row]


def test_the_path_goes_on_from_batch_to_batch(rrd: Path) -> None:
    ticks = [make_tick(3 * k, position_ned_m=Position(float(k), 0.0, 0.0)) for k in range(5)]
    seen = show(rrd, list(ticks[:3]), list(ticks[3:]))
    assert strips(seen, "scene/path") == [
        [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
        [[2, 0, 0], [3, 0, 0], [4, 0, 0]],
    ]


def test_gates_stand_where_the_course_has_them(rrd: Path) -> None:
    gate = CourseGate(Position(10.0, 2.0, -3.0), math.pi / 2, 2.0)  # flown through towards east
    seen = show(rrd, [make_tick(0)], flight=viewed(gates=(gate,)))
    corners = [list(point) for point in seen.static["/scene/gates"]["LineStrips3D:strips"][0][0]]
    assert np.allclose(sorted(corners[:4]), [[9, 2, -4], [9, 2, -2], [11, 2, -4], [11, 2, -2]])
    assert seen.static["/scene/gates"]["LineStrips3D:labels"] == [["1"]]


def make_solve(serial: int, actions: list[list[float]], **changes: Any) -> Solve:
    """The solve of tick ``serial``: a chunk with a step of 50 ms."""
    first_ns = make_tick(serial).due_ns
    values: dict[str, Any] = {
        "serial": serial,
        "started_ns": first_ns,
        "computed_ns": first_ns + 2 * NS_PER_MS,
        "reset_ns": 0,
        "state": make_state(first_ns),
        "states": np.zeros((1, 13), np.float32),
        "history": np.zeros((1, 4, 4), np.float32),
        "frame_ids": ((1,),),
        "image_ns": first_ns,
        "first_ns": first_ns,
        "step_ns": 50 * NS_PER_MS,
        "actions": np.array([actions], np.float32),
    }
    return Solve(**(values | changes))


def test_some_chunks_are_shown_over_the_time_that_they_are_for(rrd: Path) -> None:
    actions = [[0.1 * k, 0.0, 0.0, 0.0] for k in range(8)]
    solves = [make_solve(index, actions) for index in range(100)]
    seen = show(rrd, [*(make_tick(index) for index in range(100)), *solves])
    for lane, begins_ms in ((0, 0), (1, 230)):
        entity = seen.columns[f"/sticks/throttle/plan/{lane}"]
        stamps_ms = [stamp_ns / NS_PER_MS for stamp_ns in entity["time"]]
        assert stamps_ms[:9] == [begins_ms + 50 * step for step in range(9)]
        assert stamps_ms == sorted(stamps_ms)
        values = [row[0] for row in entity["Scalars:scalars"]]
        assert values[:8] == pytest.approx([0.1 * k for k in range(8)])
        assert math.isnan(values[8])


@pytest.mark.parametrize("action", get_args(ActionKind))
def test_every_plot_is_in_the_blueprint(action: ActionKind) -> None:
    def contents(node: Any) -> Iterator[str]:
        found = getattr(node, "contents", ())
        for child in found if isinstance(found, list | tuple) else ():
            yield from [str(child)] if isinstance(child, str) else contents(child)

    shown = [
        str(text).strip("/*")
        for text in contents(flight_blueprint(viewed(Contract(action=action))).root_container)
    ]
    for path, _ in styles(action):
        assert any(path == entry or path.startswith(f"{entry}/") for entry in shown), path


FLIES_INTO_A_STALLED_VIEWER = """
import sys
from helpers.factories import make_tick, make_vision_tick
from mavbridge.core.observers import ObserverThread
from mavbridge.observe.viewer import layout
from mavbridge.observe.viewer.flight import RerunView
from mavbridge.observe.viewer.layout import ViewedFlight

view = RerunView(sys.argv[1], ViewedFlight(vision_hz=30, chunk_hz=100, stick_hz=100))
observer = ObserverThread("viewer", view, capacity=100)
observer.emit(make_tick())
observer.emit(make_vision_tick())
observer.close(0.2)
print(observer.failure)
"""


def test_a_viewer_that_stalls_cannot_keep_the_process_alive() -> None:
    with socket.create_server(("127.0.0.1", 0)) as never_answers:
        url = f"rerun+http://127.0.0.1:{never_answers.getsockname()[1]}/proxy"
        flight = subprocess.run(
            [sys.executable, "-c", FLIES_INTO_A_STALLED_VIEWER, f"connect={url}"],
            env={"PYTHONPATH": os.pathsep.join(sys.path)},
            capture_output=True,
            text=True,
            timeout=60,  # far beyond what it takes; the SDK's own exit hook would wait for ever
            check=True,
        )
    assert flight.stdout == "did not finish within 0.2 s\n"


def test_rc_echo_shows_four_channels_as_they_change(rrd: Path) -> None:
    moved = (1100, 1200, 1300, 1400, 1500, 1600)
    later = [make_tick(index, rc_channels_us=moved) for index in (1, 2, 3, 4)]
    seen = show(rrd, [make_tick(0), *later])
    assert seen.rows("rc") == [[1500] * 4, [1100, 1200, 1300, 1400], [1100, 1200, 1300, 1400]]
    assert seen.times_ms("rc") == [0, 10, 40]


def test_chunks_that_nobody_flies_are_not_shown(rrd: Path) -> None:
    seen = show(rrd, [make_released_tick(0), make_solve(0, [[0.0] * 4] * 8)])
    assert "/sticks/throttle/plan/0" not in seen.columns


def in_motion(*, lean_deg: float = 0.0, north_mps: float, down_mps: float) -> VehicleState:
    """A vehicle that leans forward by the thrust that holds it."""
    half_rad = math.radians(lean_deg) / 2
    attitude = (math.cos(half_rad), 0.0, -math.sin(half_rad), 0.0)
    force = (0.0, 0.0, -GRAVITY_MPS2 / math.cos(2 * half_rad))
    values = np.array((north_mps, 0, down_mps, *attitude, 0, 0, 0, *force), np.float32)
    return make_state(START_NS, values=values)


def test_a_chunk_of_velocities_is_a_path_from_the_vehicle(rrd: Path) -> None:
    contract = Contract(action="velocity")
    tick = make_tick(0, position_ned_m=Position(1.0, 2.0, -3.0))
    state = in_motion(north_mps=2.0, down_mps=-1.0)
    solve = make_solve(0, [[2.0, 0.0, -1.0, 0.0]] * 2, state=state)
    seen = show(rrd, [tick, solve], flight=viewed(contract))
    assert np.allclose(
        strips(seen, "scene/planned"), [[[1, 2, -3], [1.1, 2, -3.05], [1.2, 2, -3.1]]]
    )


@pytest.mark.parametrize("action", ["sticks", "attitude"])
def test_actions_become_the_path_of_the_leans_that_they_mean(rrd: Path, action: Any) -> None:
    contract = Contract(
        action=action, lean_dead_zone=0.0, throttle_dead_zone=0.0, full_lean_deg=45.0
    )
    tick = make_tick(0, position_ned_m=Position(0.0, 0.0, 0.0))
    thrust = contract.hover_thrust * math.sqrt(2)
    forward = {
        "sticks": [1.0, 0.0, 1.0, 0.0],  # full climb, 45 degrees nose down
        "attitude": [thrust, 0.0, -math.radians(45.0), 0.0],
    }[action]
    state = in_motion(lean_deg=45.0, north_mps=0.0, down_mps=-contract.full_climb_mps)
    seen = show(rrd, [tick, make_solve(0, [forward] * 20, state=state)], flight=viewed(contract))
    end = strips(seen, "scene/planned")[0][-1]  # after a second
    assert end == pytest.approx([9.81 / 2, 0, -contract.full_climb_mps], rel=0.06, abs=1e-6)
