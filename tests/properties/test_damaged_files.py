"""Files from strangers, damaged or made to harm: one of our errors, or what they still hold.

Any other exception fails a test here.
"""

import json
import shutil
import struct
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from helpers.fakes import FakeClock
from mavbridge.camera.shared_memory import HEADER, MAGIC, SharedMemoryCamera
from mavbridge.commands.inspect.analysis import FlightAnalysis
from mavbridge.core.errors import MavbridgeError
from mavbridge.recording.flight_folder import open_flight
from mavbridge.recording.folder import read_meta
from mavbridge.simulation.replay.recording import open_source
from policy.adapters.interface import read_interface
from policy.checkpoints.header import read_contract
from policy.data.tables import MAX_ROWS, TICK_COLUMNS, read_table
from policy.errors import PolicyError
from sitl.camera.shm import FramePublisher

FLIGHT = Path(__file__).parents[1] / "data" / "flights" / "numpy_px4"
FILES = sorted(path.name for path in FLIGHT.iterdir())
REFUSALS = (MavbridgeError, PolicyError)
BOUNDED = settings(
    derandomize=True,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)

Damage = Callable[[bytes], bytes]


def flip(at: float, bit: int) -> Damage:
    def damage(data: bytes) -> bytes:
        place = int(at * (len(data) - 1))
        return data[:place] + bytes([data[place] ^ 1 << bit]) + data[place + 1 :]

    return damage


def overwrite(at: float, new: bytes) -> Damage:
    return lambda data: data[: int(at * len(data))] + new + data[int(at * len(data)) + len(new) :]


places = st.floats(0, 1, exclude_max=True)
damages = st.one_of(
    st.builds(flip, places, st.integers(0, 7)),
    places.map(lambda kept: lambda data: data[: int(kept * len(data))]),
    st.builds(overwrite, places, st.binary(min_size=1, max_size=40)),
    st.binary(max_size=100).map(lambda new: lambda _: new),
)


def damaged(tmp_path: Path, name: str, damage: Damage) -> Path:
    folder = tmp_path / "flight"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(FLIGHT, folder)
    (folder / name).write_bytes(damage((folder / name).read_bytes()))
    return folder


def read(folder: Path) -> None:
    flight = open_flight(folder)
    list(flight.tick_rows())
    list(flight.frame_rows())


@pytest.mark.parametrize("use", [read, open_source, FlightAnalysis])
@settings(BOUNDED, max_examples=40)
@given(name=st.sampled_from(FILES), damage=damages)
def test_a_damaged_recording_is_used_or_refused(
    use: Callable[[Path], object], name: str, damage: Damage, tmp_path: Path
) -> None:
    with suppress(*REFUSALS):
        use(damaged(tmp_path, name, damage))


@pytest.mark.parametrize("name", FILES)
def test_a_file_of_another_kind_in_its_place_is_read_or_refused(name: str, tmp_path: Path) -> None:
    for other in FILES:
        folder = damaged(tmp_path, name, lambda _, other=other: (FLIGHT / other).read_bytes())
        with suppress(*REFUSALS):
            open_source(folder)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=5,
)


@settings(BOUNDED, max_examples=60)
@given(name=st.sampled_from(["meta.json", "settings.json"]), data=st.data())
def test_a_changed_value_of_the_right_file_is_read_or_refused(
    name: str, data: st.DataObject, tmp_path: Path
) -> None:
    document = json.loads((FLIGHT / name).read_text())
    key = data.draw(st.sampled_from(sorted(document)))
    if isinstance(document[key], dict) and document[key] and data.draw(st.booleans()):
        inner = data.draw(st.sampled_from(sorted(document[key])))
        document[key][inner] = data.draw(json_values)
    else:
        document[key] = data.draw(json_values)
    folder = damaged(tmp_path, name, lambda _: json.dumps(document).encode())
    with suppress(*REFUSALS):
        read_meta(folder)
        open_source(folder)


@settings(BOUNDED, max_examples=150)
@given(header=st.binary(max_size=200), size=st.integers(0, 2**63 - 1) | st.none())
def test_a_header_of_safetensors_is_read_or_refused(
    header: bytes, size: int | None, tmp_path: Path
) -> None:
    """A claimed length of up to 2^63 bytes costs no memory."""
    path = tmp_path / "policy.safetensors"
    length = len(header) if size is None else size
    path.write_bytes(struct.pack("<Q", length) + header)
    with suppress(*REFUSALS):
        read_contract(path)


@settings(BOUNDED, max_examples=150)
@given(text=st.text(max_size=200) | st.binary(max_size=200))
def test_a_contract_file_is_read_or_refused(text: str | bytes, tmp_path: Path) -> None:
    path = tmp_path / "contract.toml"
    path.write_bytes(text.encode("utf-8", "surrogatepass") if isinstance(text, str) else text)
    with suppress(*REFUSALS):
        read_interface(path)


@pytest.fixture
def segment(tmp_path: Path) -> Iterator[Path]:
    """The file behind ``shm:NAME``, which a test fills."""
    path = Path("/dev/shm") / f"test-damaged-{tmp_path.name}"
    yield path
    path.unlink(missing_ok=True)


@settings(BOUNDED, max_examples=150)
@given(
    numbers=st.lists(st.integers(0, 2**32 - 1), min_size=4, max_size=4),
    newest=st.integers(-(2**63), 2**63 - 1),
    body=st.binary(max_size=2000),
    magic=st.sampled_from([MAGIC, b"MBSHM\0\0\2", b""]),
)
def test_a_hostile_segment_is_refused_or_shows_nothing(
    numbers: list[int], newest: int, body: bytes, magic: bytes, segment: Path
) -> None:
    segment.write_bytes(magic + struct.pack("<IIIIqq", *numbers, newest, 1) + body)
    with suppress(*REFUSALS):
        camera = SharedMemoryCamera(segment.name, clock=FakeClock())
        camera.read(0)
        camera.close()


@settings(BOUNDED, max_examples=100)
@given(newest=st.integers(-(2**63), 2**63 - 1), slots=st.binary(min_size=256, max_size=256))
def test_a_segment_of_the_right_size_with_wrong_numbers_shows_nothing_torn(
    newest: int, slots: bytes, segment: Path
) -> None:
    FramePublisher(segment.name, 2, 2)
    data = bytearray(segment.read_bytes())
    data[HEADER.size : HEADER.size + 8] = struct.pack("<q", newest)
    stride = (len(data) - 64) // 4
    for slot in range(4):
        data[64 + slot * stride : 64 + slot * stride + 24] = slots[slot * 24 : slot * 24 + 24]
    segment.write_bytes(data)
    camera = SharedMemoryCamera(segment.name, clock=FakeClock())
    frame = camera.read(0)
    camera.close()
    assert frame is None or frame.rgb.shape == (2, 2, 3)


def test_a_table_of_more_rows_than_any_flight_is_refused(tmp_path: Path) -> None:
    """A few kilobytes of Parquet can claim any number of equal rows."""
    folder = damaged(tmp_path, "ticks.parquet", lambda data: data)
    ticks = pq.read_table(folder / "ticks.parquet")
    column = pa.chunked_array([pa.repeat(pa.scalar(0, pa.int64()), MAX_ROWS + 1)])
    pq.write_table(pa.table({"index": column}), folder / "ticks.parquet", compression="zstd")
    assert (folder / "ticks.parquet").stat().st_size < 1_000_000
    assert ticks.num_rows < MAX_ROWS
    with pytest.raises(MavbridgeError, match="more rows than a flight has"):
        open_flight(folder)


def test_a_column_that_nobody_asked_for_is_not_read(tmp_path: Path) -> None:
    """A few kilobytes of Parquet can hold any number of equal texts."""
    ticks = pq.read_table(FLIGHT / "ticks.parquet")
    wide = ticks.append_column("wide", pa.repeat(pa.scalar("x" * 1000), ticks.num_rows))
    pq.write_table(wide, tmp_path / "ticks.parquet", compression="zstd")
    assert read_table(tmp_path / "ticks", TICK_COLUMNS).column_names == TICK_COLUMNS.names
