import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import pytest

from helpers.factories import make_tick
from helpers.recordings import make_frame, make_meta, number_of, without_writer_process
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FlightOutcome
from mavbridge.core.vehicle import Sticks
from mavbridge.recording import folder as names
from mavbridge.recording.flight_folder import open_flight
from mavbridge.recording.flight_writer import FlightWriter
from mavbridge.recording.folder import prepare_folder
from mavbridge.recording.meta import FlightError, read_meta, write_meta
from mavbridge.recording.rows import FrameTruth
from mavbridge.recording.tlog import open_tlog_pipe
from policy.contract import Contract


def record(folder: Path, *, ticks: int = 30, frames: int = 10) -> FlightWriter:
    folder.mkdir(parents=True)
    tlog_pipe = open_tlog_pipe()
    tlog_pipe.writer.close()
    writer = FlightWriter(folder, make_meta(), pressure="offline", tlog_pipe=tlog_pipe)
    for k in range(ticks):
        writer.tick(make_tick(k))
    for k in range(frames):
        writer.frame(make_frame(k))
    return writer


@pytest.fixture(autouse=True)
def _in_process() -> Iterator[None]:
    with without_writer_process():
        yield


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "flight"
    writer = record(folder)  # by a writer process
    writer.finish(writer.meta)
    return folder


@pytest.fixture
def flight(finished: Path, tmp_path: Path) -> Path:
    """A finished one, to spoil."""
    return Path(shutil.copytree(finished, tmp_path / "flight"))


def test_a_flight_comes_back(flight: Path) -> None:
    back = open_flight(flight)
    assert [row.tick.index for row in back.tick_rows()] == list(range(30))
    assert [row.frame_id for row in back.frame_rows()] == list(range(1, 11))
    assert [number_of(rgb) for rgb in back.images()] == list(range(10))
    expected = make_meta(
        finished=True,
        ticks=30,
        frames=10,
        ticks_dropped=0,
        frames_dropped=0,
        image_height=48,
        image_width=64,
        source_height=48,
        source_width=64,
    )
    assert back.meta == expected
    assert sorted(path.name for path in flight.iterdir()) == [
        *("camera.mp4", "frames.parquet", "link.tlog", "meta.json", "ticks.parquet")
    ]


def test_a_demonstration_has_its_labels(tmp_path: Path) -> None:
    expert = Sticks(0.25, 0.5, -0.5, 1.0)
    truth = FrameTruth(
        position_ned_m=(1.0, 2.0, -3.0),
        ned_from_body_wxyz=(1.0, 0.0, 0.0, 0.0),
        velocity_ned_mps=(0.5, 0.0, 0.0),
        next_gate=None,
        gate_body_m=None,
        gate_yaw_rad=None,
        gate_after_body_m=None,
    )
    meta = make_meta(source="demonstration", course_seed=7, conditions={"wind_mps": 3.5})
    writer = FlightWriter(tmp_path, meta, pressure="offline", with_labels=True)
    writer.tick(make_tick(0), expert)
    writer.frame(make_frame(0), truth)
    writer.finish(meta)
    back = open_flight(tmp_path)
    assert [row.expert for row in back.tick_rows()] == [expert]
    assert [row.truth for row in back.frame_rows()] == [truth]
    assert back.meta.conditions == {"wind_mps": 3.5}
    assert not (tmp_path / "link.tlog").exists()


def test_what_an_observer_missed_is_counted_before_the_next_row(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path, make_meta(), pressure="offline")
    for serial in (1, 2, 5):
        writer.tick(make_tick(serial))
        writer.frame(make_frame(serial))
    writer.finish(writer.meta)
    back = open_flight(tmp_path)
    assert [row.dropped_before for row in back.tick_rows()] == [1, 0, 2]
    assert [row.dropped_before for row in back.frame_rows()] == [1, 0, 2]
    assert [row.tick.serial for row in back.tick_rows()] == [1, 2, 5]
    assert (back.meta.ticks_dropped, back.meta.frames_dropped) == (3, 3)


def test_each_camera_has_a_video_and_a_table_of_its_own(tmp_path: Path) -> None:
    contract = Contract(cameras=("front", "down"))
    writer = FlightWriter(tmp_path, make_meta(contract=contract), pressure="offline")
    writer.tick(make_tick(0))
    for serial in range(6):
        writer.frame(make_frame(serial))
        if serial % 2 == 0 and serial != 2:  # every other one; one was lost on the way
            below = make_frame(100 + serial, camera=1, serial=serial // 2)
            writer.frame(below)
    writer.finish(writer.meta)
    first, below = open_flight(tmp_path), open_flight(tmp_path, "down")
    assert [number_of(rgb) for rgb in first.images()] == list(range(6))
    assert [number_of(rgb) for rgb in below.images()] == [100, 104]
    assert [row.dropped_before for row in below.frame_rows()] == [0, 1]
    assert (first.meta.frames, first.meta.frames_dropped) == (6, 0)
    assert open_flight(tmp_path, "front").frames.num_rows == 6
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        *("camera.mp4", "camera_down.mp4", "frames.parquet", "frames_down.parquet"),
        *("meta.json", "ticks.parquet"),
    ]
    with pytest.raises(FlightError, match="has no camera left: it has front, down"):
        open_flight(tmp_path, "left")


def test_a_flight_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    writer = record(folder, ticks=600, frames=40)
    writer.close()  # as after a kill: nothing is finished but the video
    back = open_flight(folder)
    assert not back.meta.finished
    assert 550 <= back.ticks.num_rows <= 600
    assert back.frames.num_rows == 40
    video = folder / "camera.mp4"
    video.write_bytes(video.read_bytes()[:-3000])
    back = open_flight(folder)
    assert 0 < back.frames.num_rows < 40
    assert [number_of(rgb) for rgb in back.images()] == list(range(back.frames.num_rows))


def test_a_flight_without_a_frame_is_a_flight(tmp_path: Path) -> None:
    writer = record(tmp_path / "flight", frames=0)
    writer.finish(writer.meta)
    back = open_flight(tmp_path / "flight")
    assert (back.ticks.num_rows, back.frames.num_rows) == (30, 0)
    assert list(back.images()) == []


def _without(name: str) -> Callable[[Path], object]:
    return lambda flight: (flight / name).unlink()


def _meta(**changes: object) -> Callable[[Path], object]:
    def change(flight: Path) -> None:
        path = flight / "meta.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def _damage(name: str) -> Callable[[Path], object]:
    return lambda flight: (flight / name).write_bytes(b"something else altogether")


def _as_stream(stem: str) -> Callable[[Path], object]:
    return lambda flight: (flight / f"{stem}.parquet").rename(flight / f"{stem}.arrows")


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (_without("meta.json"), "has no meta.json"),
        (_without("ticks.parquet"), "neither ticks.parquet nor ticks.arrows"),
        (_without("frames.parquet"), "lacks frames.parquet, though 10 frames were recorded"),
        (_without("camera.mp4"), "lacks camera.mp4, though 10 frames were recorded"),
        (_damage("meta.json"), "is not JSON"),
        (_damage("ticks.parquet"), "ticks.parquet is damaged"),
        (_as_stream("ticks"), "ticks.arrows is damaged"),
        (_damage("camera.mp4"), "holds none of 10 images"),
        (_meta(format="other"), "is not of a recorded flight"),
        (_meta(version=2), "has version 2 of the format, this build reads 1"),
        (_meta(contract={"horizon": 0}), "horizon must be an integer"),
        (_meta(source="dream"), "source 'dream'"),
        (_meta(outcome={"end": "duration"}), "incomplete or damaged"),
        (_meta(outcome="good"), "incomplete or damaged"),
        (_meta(start_ns="now"), "start_ns is 'now', not a number"),
    ],
)
def test_a_spoiled_flight_says_what_is_wrong(
    flight: Path, spoil: Callable[[Path], object], told: str
) -> None:
    spoil(flight)
    with pytest.raises(MavbridgeError) as error:
        open_flight(flight)
    assert told in str(error.value)


def test_what_is_no_flight_says_what_is_wanted(flight: Path) -> None:
    folder = flight.parent
    (folder / "empty").mkdir()
    for path, told in (
        (folder / "nowhere", "there is no folder"),
        (flight / "meta.json", "is a file: a recorded flight is a folder"),
        (folder / "empty", "is empty: nothing was recorded there"),
        (folder, "holds flights, and is none: name one of them"),
        (Path(__file__).parent, "is no recorded flight: it has no meta.json"),
    ):
        with pytest.raises(MavbridgeError) as error:
            open_flight(path)
        assert told in str(error.value)


def test_a_folder_that_cannot_take_a_flight_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "notes.txt").write_text("precious")
    with pytest.raises(UserError, match=r"is not empty \(it holds notes.txt\)"):
        prepare_folder(tmp_path)
    with pytest.raises(UserError, match="cannot be written"):
        prepare_folder(tmp_path / "notes.txt")
    with pytest.raises(UserError, match="cannot be written"):
        prepare_folder(Path("/proc/nowhere"))
    monkeypatch.setattr(names, "EXTRA", ("av", "no_such_module"))
    with pytest.raises(UserError, match=r"needs no_such_module: pip install no_such_module"):
        prepare_folder(tmp_path / "new")


def test_what_ran_comes_back_and_older_flights_know_nothing_of_it(flight: Path) -> None:
    meta = make_meta(
        command=("mavbridge", "--arm"),
        versions={"python": "3.12.1"},
        git_revision="abc-dirty",
        policy_files={"/w.safetensors": "00"},
        cameras={"front": "0"},
        parameters={"RC_OVERRIDE_TIME": 0.5},
    )
    write_meta(flight, meta)
    assert read_meta(flight) == meta
    document = json.loads((flight / "meta.json").read_text())
    for key in ("command", "versions", "git_revision", "policy_files", "cameras", "parameters"):
        del document[key]
    (flight / "meta.json").write_text(json.dumps(document))
    assert read_meta(flight) == make_meta()


OUTCOME = FlightOutcome(
    end="duration",
    reason=because(Code.DURATION),
    flown_s=20.0,
    height_m=3.1,
    speed_mps=0.2,
    mode="LOITER",
    is_armed=True,
    is_landed=False,
    gates_total=8,
    gates_passed=5,
    course_s=9.1,
    course_speed_mps=6.3,
    crash=None,
)


def test_the_outcome_is_kept_as_numbers_and_codes(tmp_path: Path) -> None:
    write_meta(tmp_path, make_meta().with_outcome(OUTCOME))
    written = json.loads((tmp_path / "meta.json").read_text())
    reason = {"code": "duration", "kind": "end", "data": {}, "text": "the flight is over"}
    assert written["outcome"] == asdict(OUTCOME) | {"reason": reason}
    assert written["success"] is False, "three gates are missing"
    assert read_meta(tmp_path).outcome == OUTCOME


def test_what_somebody_has_said_of_a_flight_stands() -> None:
    assert make_meta(success=True).with_outcome(OUTCOME).success is True
