from pathlib import Path
from tempfile import TemporaryDirectory

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.recordings import disk_of, make_row
from mavbridge.recording.rows import frame_columns
from mavbridge.recording.tables import TableWriter
from policy.data.tables import FRAME_COLUMNS, TICK_COLUMNS, read_table
from policy.errors import DatasetError

SCHEMA_BYTES = FRAME_COLUMNS.serialize().size


def write(stem: Path, sizes: list[int]) -> TableWriter:
    writer = TableWriter(stem, FRAME_COLUMNS)
    for size in sizes:
        add(writer, size)
    return writer


def add(writer: TableWriter, count: int) -> None:
    for _ in range(count):
        writer.add(frame_columns(make_row(writer.rows)))
    writer.flush()


@settings(max_examples=40)
@given(st.floats(0, 1))
def test_a_stream_cut_off_anywhere_has_its_whole_batches(share: float) -> None:
    with TemporaryDirectory() as folder:
        stem = Path(folder) / "frames"
        write(stem, [2, 1, 3]).abandon()
        stream = stem.with_suffix(".arrows")
        data = stream.read_bytes()
        keep = round(share * len(data))
        if keep < SCHEMA_BYTES:  # written in one piece
            keep = 0
        stream.write_bytes(data[:keep])
        ids = read_table(stem, FRAME_COLUMNS)["frame_id"].to_pylist()
    assert ids == list(range(len(ids)))
    assert len(ids) in {0, 2, 3, 6}
    if share == 1:
        assert len(ids) == 6


def test_a_full_disk_keeps_what_was_written(tmp_path: Path) -> None:
    writer = write(tmp_path / "frames", [10])
    written = (tmp_path / "frames.arrows").stat().st_size
    with disk_of(written + 100), pytest.raises(OSError, match="large"):
        add(writer, 50)
    writer.abandon()
    assert read_table(tmp_path / "frames", FRAME_COLUMNS).num_rows == 10


def test_no_room_for_parquet_leaves_the_stream(tmp_path: Path) -> None:
    writer = write(tmp_path / "frames", [500])
    with disk_of(100), pytest.raises(OSError, match="large"):
        writer.finish()
    assert [path.name for path in tmp_path.iterdir()] == ["frames.arrows"]
    assert read_table(tmp_path / "frames", FRAME_COLUMNS).num_rows == 500


def test_another_programs_table_is_refused(tmp_path: Path) -> None:
    pq.write_table(pa.table({"index": [1.5]}), tmp_path / "ticks.parquet")
    with pytest.raises(DatasetError, match="lacks the columns due_ns, woke_ns"):
        read_table(tmp_path / "ticks", TICK_COLUMNS)
