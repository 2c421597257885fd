import json
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import pyarrow.parquet as pq
import pytest

from helpers.factories import make_tick
from helpers.recordings import (
    InProcessWriter,
    disk_of,
    make_frame,
    make_meta,
    number_of,
    write_recording,
)
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.reasons import Code, because
from mavbridge.core.records import FlightOutcome, ImageArray, Tick, VisionTick
from mavbridge.recording import folder as names
from mavbridge.recording.flight_folder import open_flight
from mavbridge.recording.folder import prepare_folder, read_meta, write_meta
from mavbridge.recording.video_writer import WriterError
from policy.contract import Contract
from policy.errors import DatasetError


def events(*, ticks: int = 30, frames: int = 10) -> list[Tick | VisionTick]:
    return [*map(make_tick, range(ticks)), *map(make_frame, range(frames))]


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_recording(tmp_path_factory.mktemp("finished") / "flight", events())


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
    )
    assert back.meta == expected
    assert sorted(path.name for path in flight.iterdir()) == [
        *("camera.mp4", "frames.parquet", "meta.json", "ticks.parquet")
    ]


def test_each_camera_has_a_video_and_a_table_and_what_was_missed_is_counted(
    tmp_path: Path,
) -> None:
    """Before the next row."""
    recorded = [make(serial) for serial in (1, 2, 5) for make in (make_tick, make_frame)]
    recorded += [make_frame(100 + serial, camera=1, serial=serial) for serial in (0, 2)]
    meta = make_meta(contract=Contract(cameras=("front", "down")))
    folder = write_recording(tmp_path / "flight", recorded, meta=meta)
    first, below = open_flight(folder, "front"), open_flight(folder, "down")
    assert [(row.tick.serial, row.dropped_before) for row in first.tick_rows()] == [
        *((1, 1), (2, 0), (5, 2))
    ]
    for back, numbers, dropped in ((first, [1, 2, 5], [1, 0, 2]), (below, [100, 102], [0, 1])):
        assert [number_of(rgb) for rgb in back.images()] == numbers
        assert [row.dropped_before for row in back.frame_rows()] == dropped
    meta = first.meta
    assert (meta.frames, meta.ticks_dropped, meta.frames_dropped) == (3, 3, 3 + 1)
    assert sorted(path.name for path in folder.iterdir()) == [
        *("camera.mp4", "camera_down.mp4", "frames.parquet", "frames_down.parquet"),
        *("meta.json", "ticks.parquet"),
    ]
    with pytest.raises(DatasetError, match="has no camera left: it has front, down"):
        open_flight(folder, "left")


def test_a_frame_that_the_video_does_not_take_is_told_by_the_next_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    submit = InProcessWriter.submit

    def take_some(self: InProcessWriter, rgb: ImageArray, captured_ns: int) -> bool:
        return number_of(rgb) not in (0, 3, 4, 9) and submit(self, rgb, captured_ns)

    monkeypatch.setattr(InProcessWriter, "submit", take_some)
    recorded = [make_frame(number, serial=number + (number > 5)) for number in range(10)]
    back = open_flight(write_recording(tmp_path / "flight", recorded))
    assert [row.frame_id - 1 for row in back.frame_rows()] == [1, 2, 5, 6, 7, 8]
    assert [row.dropped_before for row in back.frame_rows()] == [1, 0, 2, 1, 0, 0]
    assert (back.meta.frames, back.meta.frames_dropped) == (6, 4 + 1)


def test_a_flight_without_a_frame_is_a_flight(tmp_path: Path) -> None:
    back = open_flight(write_recording(tmp_path / "flight", events(frames=0)))
    assert (back.ticks.num_rows, back.frames.num_rows) == (30, 0)
    assert list(back.images()) == []


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    """Libraries take a colon for an address, and cannot encode a name that is not UTF-8."""
    back = open_flight(write_recording(tmp_path / os.fsdecode(b"10:30 \xfc"), events()))
    assert (back.ticks.num_rows, len(list(back.images()))) == (30, 10)


Spoil = Callable[[Path], object]


def _without(name: str) -> Spoil:
    return lambda flight: (flight / name).unlink()


def _meta(**changes: object) -> Spoil:
    def change(flight: Path) -> None:
        path = flight / "meta.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | changes))

    return change


def _damage(name: str) -> Spoil:
    return lambda flight: (flight / name).write_bytes(b"something else altogether")


def _pointer(name: str) -> Spoil:
    return lambda flight: (flight / name).write_text("version https://git-lfs.github.com/spec/v1\n")


def _one_column_twice(flight: Path) -> None:
    table = pq.read_table(flight / "ticks.parquet")
    pq.write_table(table.append_column("woke_ns", table["woke_ns"]), flight / "ticks.parquet")


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (_one_column_twice, "ticks.parquet has two columns of one name"),
        (_without("meta.json"), "has no meta.json"),
        (_without("ticks.parquet"), "neither ticks.parquet nor ticks.arrows"),
        (_without("frames.parquet"), "lacks frames.parquet, though 10 frames were recorded"),
        (_without("camera.mp4"), "lacks camera.mp4, though 10 frames were recorded"),
        (_damage("meta.json"), "is not JSON"),
        (_damage("ticks.parquet"), "ticks.parquet cannot be read"),
        (_pointer("ticks.parquet"), "fetch it with `git lfs pull`"),
        (_pointer("camera.mp4"), "fetch it with `git lfs pull`"),
        (
            lambda flight: (flight / "ticks.parquet").rename(flight / "ticks.arrows"),
            "ticks.arrows cannot be read",
        ),
        (_damage("camera.mp4"), "holds none of 10 images"),
        (_meta(format="other"), "is not of a recorded flight"),
        (_meta(version=2), "has version 2 of the format, this build reads 1"),
        (_meta(contract={"horizon": 0}), "horizon must be an integer"),
        (_meta(source="dream"), "source is .dream., not flight or demonstration"),
        (_meta(outcome={"end": "duration"}), "incomplete or damaged"),
        (_meta(outcome="good"), "incomplete or damaged"),
        (_meta(start_ns="now"), "start_ns is .now., not int"),
    ],
)
def test_a_spoiled_flight_says_what_is_wrong(flight: Path, spoil: Spoil, told: str) -> None:
    spoil(flight)
    with pytest.raises(MavbridgeError, match=told):
        open_flight(flight)


def test_what_is_no_flight_says_what_is_wanted(flight: Path) -> None:
    folder = flight.parent
    (folder / "empty").mkdir()
    (folder / "odd/meta.json").mkdir(parents=True)
    for path, told in (
        (folder / "odd", "odd/meta.json cannot be read: it is a folder"),
        (folder / "nowhere", "there is no folder"),
        (flight / "meta.json", "is a file: a recorded flight is a folder"),
        (folder / "empty", "is empty: nothing was recorded there"),
        (folder, "holds flights, and is none: name one of them"),
        (Path(__file__).parent, "is no recorded flight: it has no meta.json"),
    ):
        with pytest.raises(MavbridgeError, match=told):
            open_flight(path)


def test_a_folder_that_cannot_take_a_flight_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "notes.txt").write_text("precious")
    with pytest.raises(UserError, match=r"is not empty \(it holds notes.txt\)"):
        prepare_folder(tmp_path, "--out")
    with pytest.raises(UserError, match="cannot be written"):
        prepare_folder(tmp_path / "notes.txt", "--out")
    with pytest.raises(UserError, match="--out /proc/nowhere cannot be written"):
        prepare_folder(Path("/proc/nowhere"), "--out")
    monkeypatch.setattr(names, "EXTRA", ("av", "no_such_module"))
    with pytest.raises(MavbridgeError, match=r"needs no_such_module: pip install no_such_module"):
        prepare_folder(tmp_path / "new", "--out")


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
    known_since = {"command", "versions", "git_revision", "policy_files", "cameras", "parameters"}
    document = json.loads((flight / "meta.json").read_text())
    older = {key: value for key, value in document.items() if key not in known_since}
    (flight / "meta.json").write_text(json.dumps(older))
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
    assert make_meta(success=True).with_outcome(OUTCOME).success is True, "somebody has said so"


@pytest.mark.parametrize(
    ("room", "ticks", "readable"),
    [(10, 3, None), (12_000, 60, 0), (5_000, 3, 0), (9_000, 3, 3)],
    ids=["meta", "flush", "last flush", "parquet"],
)
def test_a_full_disk_is_told_wherever_it_is_met(
    tmp_path: Path, room: int, ticks: int, readable: int | None
) -> None:
    told = pytest.raises(WriterError, match="flight cannot be written: File too large")
    with disk_of(room), told:
        write_recording(tmp_path / "flight", [make_tick(number) for number in range(ticks)])
    if readable is not None:
        flight = open_flight(tmp_path / "flight")
        assert (flight.meta.finished, flight.ticks.num_rows) == (False, readable)
