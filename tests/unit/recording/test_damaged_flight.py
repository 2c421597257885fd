"""A damaged recording is read up to the damage, and every reader says what is lost."""

import json
import shutil
from functools import partial
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from helpers.factories import make_tick
from helpers.recordings import fragment, make_frame, number_of, write_recording
from mavbridge.commands.config import InspectConfig
from mavbridge.commands.inspect import inspect
from mavbridge.recording.flight_folder import open_flight
from policy.data.flight_folders import read_flight
from policy.errors import DatasetError

TICKS, FRAMES = 6000, 90
START = Path(__file__).parents[3] / "examples/start"
fly_tick = partial(make_tick, phase="flying")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    events = [*map(make_frame, range(FRAMES)), *map(fly_tick, range(TICKS))]
    return write_recording(tmp_path_factory.mktemp("finished") / "flight", events)


@pytest.fixture
def flight(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "flight"))


def spoil(path: Path, start: int, end: int) -> None:
    data = bytearray(path.read_bytes())
    data[start:end] = bytes(byte ^ 0x55 for byte in data[start:end])
    path.write_bytes(data)


def spoil_second_group(path: Path) -> None:
    """Damage the last bytes of woke_ns, which are values."""
    group = pq.read_metadata(path).row_group(1)
    column = group.column(2)
    start = column.dictionary_page_offset or column.data_page_offset
    end = start + column.total_compressed_size
    spoil(path, end - 4, end)


def spoil_image(folder: Path, number: int) -> None:
    path = folder / "camera.mp4"
    spoil(path, *fragment(path.read_bytes(), number))


def test_rows_before_damaged_ones_are_read_and_those_behind_are_counted(flight: Path) -> None:
    first = pq.read_metadata(flight / "ticks.parquet").row_group(0).num_rows
    spoil_second_group(flight / "ticks.parquet")
    back = open_flight(flight)
    read = [(row.tick.index, row.tick.serial) for row in back.tick_rows()]
    assert read == [(index, index) for index in range(first)]
    (text,) = back.damage
    lost = TICKS - first
    assert f"ticks.parquet is damaged: its last {lost} of {TICKS} rows were skipped" in text
    learnt = read_flight(flight)
    assert (len(learnt.tick_ns), learnt.damage) == (first, (text,))


def test_rows_keep_their_images_where_the_video_is_damaged(flight: Path) -> None:
    spoil_image(flight, 40)
    back = open_flight(flight)
    assert [number_of(rgb) for rgb in back.images()] == list(range(40))
    assert [row.frame_id - 1 for row in back.frame_rows()] == list(range(40))
    assert len(back.damage) == 2
    learnt = read_flight(flight)
    assert [number_of(rgb) for rgb in learnt.decode()] == list(range(40))
    stamps = [row.captured_ns for row in back.frame_rows()]
    assert (learnt.captured_ns.tolist(), learnt.damage) == (stamps, back.damage)


def test_a_flight_that_was_cut_off_is_read_as_far_as_it_goes(tmp_path: Path) -> None:
    events = [*map(make_frame, range(40)), *map(fly_tick, range(1000))]
    folder = write_recording(tmp_path / "flight", events, finish=False)
    back = open_flight(folder)
    assert not back.meta.finished
    assert (back.ticks.num_rows, back.frames.num_rows) == (1000, 40)
    stream, video = folder / "ticks.arrows", folder / "camera.mp4"
    stream.write_bytes(stream.read_bytes()[:-100])
    video.write_bytes(video.read_bytes()[:-3000])
    back = open_flight(folder)
    assert 0 < back.ticks.num_rows < 1000
    assert any("ticks.arrows" in text for text in back.damage)
    assert len(read_flight(folder).tick_ns) == back.ticks.num_rows
    assert 0 < back.frames.num_rows < 40
    assert [number_of(rgb) for rgb in back.images()] == list(range(back.frames.num_rows))


def test_inspect_says_so(flight: Path, capsys: pytest.CaptureFixture[str]) -> None:
    spoil_second_group(flight / "ticks.parquet")
    spoil_image(flight, 40)
    (flight / "packets.parquet").write_bytes(b"something else")
    written = flight.parent / "inspect.json"
    assert inspect([flight], InspectConfig(json=written)) == 0
    (document,) = json.loads(written.read_text())
    for name in ("ticks.parquet", "camera.mp4"):
        assert any(f"{name} is damaged" in text for text in document["damage"])
    assert any("packets.parquet cannot be read" in text for text in document["damage"])
    assert "damage" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("column", "said"),
    [
        *((name, f"holds null in {name}") for name in ("due_ns", "texts", "is_coasting")),
        *(("rate_ns", "state without rate_ns"), ("slewed", "raw without slewed")),
        ("sent", "holds null in sent"),
    ],
)
def test_a_value_that_every_row_has_is_missed(flight: Path, column: str, said: str) -> None:
    table = pq.read_table(flight / "ticks.parquet")
    null = [None] * 4 if column == "sent" else None
    values = pa.array([null] * table.num_rows, table.schema.field(column).type)
    place = table.column_names.index(column)
    pq.write_table(table.set_column(place, column, values), flight / "ticks.parquet")
    with pytest.raises((DatasetError, DatasetError), match=said):
        inspect((flight,), InspectConfig())


def test_the_truth_of_a_frame_is_whole_or_absent_and_of_its_type(tmp_path: Path) -> None:
    shutil.copytree(START, folder := tmp_path / "a")
    path = folder / "frames.parquet"
    table = pq.read_table(path)
    pq.write_table(table.drop_columns(["next_gate"]), path)
    assert next(open_flight(folder).frame_rows()).truth.next_gate is None
    for name in ("position_ned_m", "ned_from_body_wxyz"):
        place, kind = table.column_names.index(name), table.schema.field(name).type
        pq.write_table(table.set_column(place, name, pa.nulls(table.num_rows, kind)), path)
        assert {row.truth for row in open_flight(folder).frame_rows()} == {None}
        words = pa.array(["north"] * table.num_rows)
        pq.write_table(table.set_column(place, name, words), path)
        with pytest.raises(DatasetError, match=f"{name} must hold"):
            open_flight(folder)
