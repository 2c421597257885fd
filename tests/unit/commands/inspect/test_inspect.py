import io
import json
import os
import sys
from base64 import b64decode
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from helpers.factories import make_released_tick, make_state, make_tick
from helpers.programs import ended
from helpers.recordings import make_frame, make_meta, write_recording
from mavbridge.commands.config import InspectConfig
from mavbridge.commands.inspect import _events as events_of
from mavbridge.commands.inspect import inspect, print_flight
from mavbridge.commands.inspect.analysis import FlightAnalysis
from mavbridge.commands.inspect.page import page_data
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.course import CourseGate
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.reasons import Code, because, reason_to_json
from mavbridge.core.records import FlightOutcome, Position, Tick, VehicleState, VisionTick
from policy.contract import Contract

GOLDEN = Path(__file__).parents[3] / "data/flights"
LINK_LOST = because(Code.HEARTBEAT_LOST)


def write(
    folder: Path, events: Sequence[Tick | VisionTick], *, frames: int = 10, **changes: Any
) -> Path:
    """A recording of ``events``, behind so many frames of the first camera."""
    return write_recording(folder, [*map(make_frame, range(frames)), *events], **changes)


def flown(count: int) -> list[Tick]:
    return [make_tick(index) for index in range(count)]


def _aged(index: int, values: np.ndarray) -> VehicleState:
    """State of a tick whose attitude is as old as that of ``make_tick``."""
    return make_state(make_tick(index).state.attitude_ns, values=values)


def flight_with_a_stall() -> list[Tick]:
    """A second of flight; a release at 0.9 s, and before it two chunks that came 30 ms late."""
    ticks = [make_released_tick(0, because(Code.NOT_ARMED), phase="waiting")]
    for index in range(1, 90):
        tick = make_tick(index, phase="flying", position_ned_m=Position(0.1 * index, 0.0, -2.0))
        if index == 50:
            computed_ns = (tick.chunk_computed_ns or 0) + 9 * NS_PER_MS
            tick = replace(tick, chunk_computed_ns=computed_ns, predict_ns=11 * NS_PER_MS)
        ticks.append(tick)
    ticks += [make_released_tick(i, LINK_LOST, phase="released") for i in range(90, 100)]
    return ticks


def shown(flight: FlightAnalysis) -> str:
    console = Console(width=80, record=True, file=io.StringIO())
    print_flight(flight, console)
    return console.export_text()


@pytest.fixture(scope="module")
def stalled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("stalled") / "flight", flight_with_a_stall())


def test_each_flight_is_told_with_its_figures_causes_and_moments(
    stalled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flight = FlightAnalysis(stalled)
    assert [moment.what for moment in flight.moments] == ["the policy's flight ended", "late chunk"]
    assert flight.moments[0].t_s == pytest.approx(0.9)
    text = shown(flight)
    assert all(len(line) <= 80 for line in text.splitlines())
    for expected in ("the policy took long (1)", str(LINK_LOST), "9.0 ms late", "predict"):
        assert expected in " ".join(text.split())
    other = write(tmp_path / "other", flown(9))
    assert inspect([stalled, other], InspectConfig(json=tmp_path / "figures.json")) == 0
    document, second = json.loads((tmp_path / "figures.json").read_text())
    assert second["report"]["sticks"]["sends"] == 9
    assert document["report"]["sticks"]["sends"] == 89
    assert document["causes"] == {"the policy took long": 1}
    release = {"t_s": 0.9, "reason": reason_to_json(LINK_LOST)}
    assert document["report"]["releases"] == [release]
    assert [span["reason"] for span in document["holders"][1:]] == [None, release["reason"]]
    told = capsys.readouterr().out
    assert told.index("The worst moments") < told.index(str(other))


def test_a_terminal_without_utf8_gets_escapes_and_the_page_is_whole(tmp_path: Path) -> None:
    write(tmp_path / "flight", flown(9), meta=make_meta(policy="飛"))
    c_locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    environment = os.environ | c_locale | {"PYTHONPATH": str(GOLDEN.parents[2])}
    words = ("-m", "mavbridge", "inspect", "flight", "--html", "page.html")
    process = ended(sys.executable, *words, cwd=tmp_path, env=environment)
    assert process.returncode == 0, process.stderr
    assert "\\u98db on torch" in process.stdout
    assert "■" in (tmp_path / "page.html").read_text(encoding="utf-8")  # of its script


def test_plots_hold_what_was_sent_and_axes_of_ros_become_ned_axes(tmp_path: Path) -> None:
    # Facing east, level, going east and up, turning left: yaw is 90 degrees in NED.
    values = np.array([3, 0, 1, 1, 0, 0, 0, 0, 0, 0.5, 0, 0, 9.81], np.float32)
    place = Position(1, 2, -3)
    ticks = [make_tick(k, state=_aged(k, values), position_ned_m=place) for k in range(3)]
    meta = make_meta(contract=Contract(state_frame="enu_flu"))
    (page,) = json.loads(page_data([FlightAnalysis(write(tmp_path / "flight", ticks, meta=meta))]))
    last = {
        plot["title"]: [
            np.frombuffer(b64decode(each["values"]), "<f4")[-1] for each in plot["series"]
        ]
        for plot in page["plots"]
    }
    for title, expected in (
        ("Age when sent", [40.0, 3.0]),
        ("Lateness", [2.0]),
        ("Height above the origin", [3.0]),
        ("Velocity", [0, 3, -1]),
        ("Attitude", [0, 0, 90]),
        ("Body rates", [0, 0, -28.6479]),
    ):
        assert last[title] == pytest.approx(expected, abs=1e-3), title


def test_gates_are_those_of_the_course(tmp_path: Path) -> None:
    folder = write(tmp_path / "flight", [make_tick(0)], meta=make_meta(course_seed=3))
    assert len(FlightAnalysis(folder).gates) == 8
    named = tmp_path / "gates.json"
    named.write_text('{"gates": [{"center_ned_m": [1, 2, -3], "yaw_rad": 0.5, "size_m": 2}]}')
    assert FlightAnalysis(folder, gates=named).gates == (CourseGate(Position(1, 2, -3), 0.5, 2),)


def moments_of(folder: Path, ticks: list[Tick], **changes: object) -> list[tuple[str, str]]:
    flight = FlightAnalysis(write(folder, ticks, frames=0, meta=make_meta(**changes)))
    return [(moment.what, moment.detail) for moment in flight.moments]


def test_a_planned_end_is_no_bad_moment_and_any_other_end_is(tmp_path: Path) -> None:
    before = flown(50)
    for code in (Code.DURATION, Code.LANDED, Code.OPERATOR):
        ended = make_released_tick(50, because(code, what="flight"), phase="leaving")
        assert moments_of(tmp_path / code, [*before, ended]) == []
    ((what, detail),) = moments_of(
        tmp_path / "fault", [*before, make_released_tick(50, LINK_LOST, phase="leaving")]
    )
    assert what == "the policy's flight ended"
    assert detail == (
        f"{LINK_LOST}; its last sticks were by an attitude of 3 ms ago and an image of 40 ms ago"
    )


def test_the_death_of_the_guard_is_the_worst_moment_although_no_tick_tells_it(
    tmp_path: Path,
) -> None:
    rest: dict[str, Any] = dict.fromkeys(
        ("height_m", "speed_mps", "mode", "gates_total", "gates_passed", "course_s")
    )
    rest |= dict.fromkeys(("is_landed", "course_speed_mps", "crash")) | {"is_armed": True}
    reason = because(Code.GUARD_DIED)
    died = FlightOutcome(end="fault", reason=reason, flown_s=0.5, **rest)
    (worst,) = moments_of(tmp_path / "flight", flown(50), outcome=died)
    assert worst[0] == "the policy's flight ended"
    assert worst[1].startswith(f"{reason}; its last sticks were by")


def test_coasting_is_told_with_its_reason_even_where_the_recording_ends(tmp_path: Path) -> None:
    ticks = flown(50)
    old = {"state": ticks[49].state, "chunk_serial": 49, "is_coasting": True}
    old["chunk_computed_ns"] = ticks[49].chunk_computed_ns
    ticks += [make_tick(index, **old) for index in range(61, 65)]
    ticks = [replace(tick, serial=serial) for serial, tick in enumerate(ticks)]
    told = dict(moments_of(tmp_path / "flight", ticks))
    assert told["coasting"] == (
        "for 32 ms along an old chunk: its attitude was 123 ms old, beyond 100 ms"
    )


def test_close_moments_are_told_as_one(tmp_path: Path) -> None:
    ticks = flown(100)
    image_ns = ticks[50].sent_ns - 200 * NS_PER_MS
    ticks[50] = replace(
        ticks[50],
        feature_captured_ns=image_ns,
        chunk_computed_ns=(ticks[50].chunk_computed_ns or 0) + 9 * NS_PER_MS,
        predict_ns=11 * NS_PER_MS,
    )
    ((what, detail),) = moments_of(tmp_path / "flight", ticks)
    assert what == "old image"
    assert detail == (
        "sticks by an image of 200 ms ago; late chunk: 9.0 ms late: the policy took long"
    )


def test_a_crash_is_a_moment_with_its_time(tmp_path: Path) -> None:
    ticks = flown(100)
    ticks[60] = replace(ticks[60], texts=("vehicle: Crash: Disarming",))
    flight = FlightAnalysis(
        write(tmp_path / "flight", ticks, frames=0, meta=make_meta(crash="the vehicle said so"))
    )
    assert [(moment.what, moment.t_s) for moment in flight.moments] == [("crash", 0.6)]


def test_what_the_recorder_has_lost_is_neither_jitter_nor_the_cameras(tmp_path: Path) -> None:
    frames = [make_frame(number) for number in range(15, 30)]
    ticks = [make_tick(index) for index in (*range(50), *range(550, 600))]
    flight = FlightAnalysis(write(tmp_path / "flight", [*frames, *ticks], finish=False))
    assert flight.report.sticks.rate_hz == pytest.approx(100)
    assert flight.report.sticks.flying_s == pytest.approx(0.98)
    assert flight.report.vision.rate_hz == pytest.approx(30, abs=0.01)
    assert flight.report.vision.dropped_frames is None
    assert flight.report.observer_drops.recorder == 505
    assert [moment.what for moment in flight.moments] == ["rows lost"]
    text = shown(flight)
    assert "not measured" in text
    assert "cut off" in text


@pytest.mark.parametrize(("rates_hz", "gaps"), [((), 1), ((30.0, 2.0), 0)])
def test_a_gap_of_any_camera_is_a_moment(
    tmp_path: Path, rates_hz: tuple[float, ...], gaps: int
) -> None:
    contract = Contract(cameras=("front", "down"), camera_rates_hz=rates_hz)
    late = [make_frame(number, camera=1, serial=at) for at, number in enumerate((0, 1, 14, 15))]
    folder = write(
        tmp_path / "flight", [*late, *flown(90)], frames=27, meta=make_meta(contract=contract)
    )
    told = [(each.what, each.detail) for each in FlightAnalysis(folder).moments]
    detail = "433 ms without an exposure of camera down that was used"
    assert told == [("gap between images", detail)] * gaps


@pytest.mark.parametrize("is_whole", [True, False])
def test_all_cameras_are_told_and_shown(tmp_path: Path, is_whole: bool) -> None:
    contract = Contract(cameras=("front", "down"))
    events = [make_frame(number, camera=1) for number in (0, 1, 3, 4)] + flown(20)
    meta = make_meta(contract=contract)
    folder = write(tmp_path / "flight", events, frames=6, meta=meta, finish=is_whole)
    flight = FlightAnalysis(folder)
    rows = {name: camera.frames.num_rows for name, camera in flight.cameras.items()}
    assert rows == {"front": 6, "down": 4}
    assert "down: p50" in shown(flight)
    assert flight.report.observer_drops.recorder == 1
    images = [event for event in events_of(flight) if isinstance(event, VisionTick)]
    assert [image.camera for image in images].count(1) == 4
    out = tmp_path / "flight.rrd"
    assert inspect([folder], InspectConfig(rerun=str(out))) == 0
    assert out.stat().st_size > 10_000


@pytest.mark.parametrize(
    "damage", [{"action_hz": 0}, {"visual_hz": -1}, {"course_seed": "7"}, {"ticks_dropped": "9"}]
)
def test_facts_that_nothing_can_be_counted_with_are_refused_by_name(
    tmp_path: Path, damage: dict[str, object]
) -> None:
    folder = write(tmp_path / "flight", [make_tick(0)])
    meta = json.loads((folder / "meta.json").read_text())
    (folder / "meta.json").write_text(json.dumps(meta | damage))
    with pytest.raises(MavbridgeError, match=f"meta.json.*: {next(iter(damage))} is"):
        FlightAnalysis(folder)


def test_a_pilots_flight_is_judged_by_its_rows_alone(tmp_path: Path) -> None:
    ticks = [make_released_tick(k, because(Code.PILOT_FLIES), phase="released") for k in range(100)]
    ticks[10:20] = [replace(tick, rc_sticks=None) for tick in ticks[10:20]]
    meta = make_meta(source="pilot", policy=None, engine=None)
    text = shown(FlightAnalysis(write(tmp_path / "flight", ticks, frames=30, meta=meta)))
    assert "100.0 Hz of 100 Hz, the pilot's sticks known in 90.0% of them" in text
    assert "30.0 Hz of 30 Hz" in text
    assert "no moment went wrong" in text
    for word in ("slot", "chunk", "released"):
        assert word not in text.replace("the pilot flies", "")
