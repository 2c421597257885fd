"""LeRobot datasets of somebody else: what is taken, what is refused and with which words."""

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from helpers.flight_folders import LEVEL, spot
from policy.contract import ACTION_NAMES, STATE_NAMES
from policy.data.lerobot import read_dataset
from policy.data.lerobot_format import is_lerobot
from policy.errors import DatasetError

FPS, SIZE = 25, 32
LENGTHS = (12, 8)
CAMERA = "observation.images.nose"
ROWS, EPISODES = "data/chunk-000/file-000.parquet", "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mp4"
IMAGES = [[spot(SIZE, 2 * k / 12 - 1 + 0.1 * e) for k in range(n)] for e, n in enumerate(LENGTHS)]
ALL_IMAGES = [*IMAGES[0], *IMAGES[1]]


def feature(dtype: str, shape: list[int], named: object) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "names": named}


COLOUR = feature("video", [SIZE, SIZE, 3], ["height", "width", "channels"])


def write(root: Path, *, kind: str = "video", state: object = LEVEL) -> Path:
    """A dataset without any column of ours."""
    features = {
        CAMERA: {**COLOUR, "dtype": kind},
        "observation.state": feature("float32", [13], list(STATE_NAMES)),
        "action": feature("float32", [4], {"motors": list(ACTION_NAMES)}),
        "timestamp": feature("float32", [1], None),
    }
    info = {"codebase_version": "v3.0", "fps": FPS, "features": features}
    for folder in ("meta/episodes/chunk-000", "data/chunk-000", f"videos/{CAMERA}/chunk-000"):
        (root / folder).mkdir(parents=True)
    (root / "meta/info.json").write_text(json.dumps(info))
    index = [e for e, length in enumerate(LENGTHS) for _ in range(length)]
    place = [k for length in LENGTHS for k in range(length)]
    rows = {
        "observation.state": pa.array([state] * len(index), pa.list_(pa.float32(), 13)),
        "action": pa.array([(k / 20, 0, 0, 0) for k in place], pa.list_(pa.float32(), 4)),
        "timestamp": pa.array([k / FPS for k in place], pa.float32()),
        "episode_index": pa.array(index, pa.int64()),
    }
    if kind == "image":
        encoded = [cv2.imencode(".png", image[..., ::-1])[1].tobytes() for image in ALL_IMAGES]
        cells = [{"bytes": value, "path": None} for value in encoded]
        rows[CAMERA] = pa.array(cells, pa.struct([("bytes", pa.binary()), ("path", pa.string())]))
    else:
        encode(root / VIDEO, ALL_IMAGES)
    pq.write_table(pa.table(rows), root / ROWS)
    episodes = {
        "episode_index": [0, 1],
        "length": list(LENGTHS),
        "data/chunk_index": [0, 0],
        "data/file_index": [0, 0],
        f"videos/{CAMERA}/chunk_index": [0, 0],
        f"videos/{CAMERA}/file_index": [0, 0],
        f"videos/{CAMERA}/from_timestamp": [0.0, LENGTHS[0] / FPS],
    }
    pq.write_table(pa.table(episodes), root / EPISODES)
    return root


def encode(path: Path, images: list[np.ndarray]) -> None:
    with av.open(str(path), "w") as container:
        # frames before and after, as other programs encode
        stream = container.add_stream("libx264", rate=FPS, options={"crf": "12", "g": "10"})
        stream.height, stream.width, stream.pix_fmt = SIZE, SIZE, "yuv420p"
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


@pytest.mark.parametrize("kind", ["video", "image"])
def test_a_foreign_dataset_has_its_timestamps_for_everything(kind: str, tmp_path: Path) -> None:
    assert not is_lerobot(tmp_path)
    assert is_lerobot(write(tmp_path / "a", kind=kind))
    episodes = read_dataset(tmp_path / "a")
    assert [len(episode.tick_ns) for episode in episodes] == list(LENGTHS)
    assert all(len(episode.age_ns) == 0 for episode in episodes)
    for number, episode in enumerate(episodes):
        for name in ("tick_ns", "attitude_ns", "velocity_ns", "target_ns", "sent_ns"):
            np.testing.assert_array_equal(getattr(episode, name), episode.captured_ns)
        np.testing.assert_allclose(np.diff(episode.captured_ns), 40_000_000, atol=100)
        np.testing.assert_allclose(episode.target[:, 0], np.arange(LENGTHS[number]) / 20)
        np.testing.assert_array_equal(episode.sent, episode.target)
        after = np.stack(list(episode.decode())).astype(int)
        assert np.abs(after - np.stack(IMAGES[number])).mean(axis=(1, 2, 3)).max() < 4.0


def test_the_frame_of_the_state_is_where_gravity_says(tmp_path: Path) -> None:
    flu = (*LEVEL[:-1], 9.8)
    assert read_dataset(write(tmp_path / "a"))[0].contract.state_frame == "ned_frd"
    assert (
        read_dataset(write(tmp_path / "b", state=flu), CAMERA)[0].contract.state_frame == "enu_flu"
    )
    with pytest.raises(DatasetError, match="no camera tail"):
        read_dataset(tmp_path / "a", "tail")


def test_the_frame_that_the_contract_file_says_is_taken(tmp_path: Path) -> None:
    """A vehicle's acceleration without gravity, or in g, tells no axes."""
    still = (*LEVEL[:-1], 0.02)
    dataset = write(tmp_path / "a", state=still)
    with pytest.raises(DatasetError, match=r"az_mps2 is 0\.0 in the median.*state_frame"):
        read_dataset(dataset)
    contract = dataset / "mavbridge.toml"
    contract.write_text('[contract]\nstate_frame = "?"\n')
    with pytest.raises(DatasetError, match="az_mps2 is"):
        read_dataset(dataset)
    for frame in ("ned_frd", "enu_flu"):
        contract.write_text(f'[contract]\nstate_frame = "{frame}"\n')
        assert read_dataset(dataset)[0].contract.state_frame == frame
    noted = {"info": {"state_frame": "ned_frd"}}
    _info(lambda info: info["features"]["observation.state"].update(noted))(dataset)
    with pytest.raises(DatasetError, match=r"frame is 'ned_frd', in mavbridge\.toml 'enu_flu'"):
        read_dataset(dataset)
    contract.write_text("[action]\nscale = [0.01, 0.01, 0.01, 0.01]\n")
    with pytest.raises(DatasetError, match=r"\[action\] scale is not applied to data"):
        read_dataset(dataset)


BEGIN = f"videos/{CAMERA}/from_timestamp"
Spoil = Callable[[Path], None]
TWO_CAMERAS = {"observation.images.tail": COLOUR}


def _info(change: Callable[[dict[str, Any]], object]) -> Spoil:
    def spoil(root: Path) -> None:
        info = json.loads((root / "meta/info.json").read_text())
        change(info)
        (root / "meta/info.json").write_text(json.dumps(info))

    return spoil


def _state(**changes: object) -> Spoil:
    return _info(lambda info: info["features"]["observation.state"].update(changes))


def _table(change: Callable[[pa.Table], pa.Table], path: str = ROWS) -> Spoil:
    return lambda root: pq.write_table(change(pq.read_table(root / path)), root / path)


def _column(name: str, values: Any, path: str = ROWS) -> Spoil:
    return _table(lambda t: t.set_column(t.column_names.index(name), name, values), path)


def _rows(name: str, change: Callable[[list[Any]], list[Any]], path: str = ROWS) -> Spoil:
    def spoil(root: Path) -> None:
        column = pq.read_table(root / path)[name]
        _column(name, pa.array(change(column.to_pylist()), column.type), path)(root)

    return spoil


def _nan(values: list[Any]) -> list[Any]:
    return [*values[:3], [np.nan] * len(values[3]), *values[4:]]


RAGGED = pa.array([[0.0] * width for width in (3, 5, *[4] * 18)], pa.list_(pa.float32()))


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (_info(lambda info: info.update(codebase_version="v2.1")), "convert_dataset_v21_to_v30"),
        (_info(lambda info: info.update(fps=0)), "fps"),
        (_info(lambda info: info.update(video_path="a/{video_key}.mp4")), "copy the dataset"),
        (_info(lambda info: info.update(video_path="{drone}.mp4")), "where its files are"),
        (_info(lambda info: info["features"].pop("observation.state")), "no feature observation"),
        (_info(lambda info: info["features"].pop(CAMERA)), "no camera"),
        (_info(lambda info: info["features"].update(TWO_CAMERAS)), "--camera-key"),
        (_state(names=list(STATE_NAMES[::-1])), "in this order"),
        (_state(info={"state_frame": "body"}), "state frame is 'body'"),
        (_state(info={"state_frame": ["ned_frd"]}), "state frame is .'ned_frd'., in "),
        (_rows("observation.state", _nan), "NaN or infinity in row 3"),
        (_column("action", RAGGED), "action must hold 4 numbers a row"),
        (_column("action", pa.array(["a"] * 20, pa.string_view())), "must hold 4 numbers a row"),
        (_column("episode_index", pa.array([[1.0]] * 20)), "episode_index must hold int64, not"),
        (_column("length", pa.array(["a", "b"]), EPISODES), "length must hold int64, not string"),
        (_rows("timestamp", lambda v: [None, *v[1:]]), "holds null in timestamp"),
        (_rows("timestamp", lambda v: [3 * t for t in v]), "row 11 is 0.88 s off: .* 1 / 25 s"),
        (_rows("timestamp", lambda v: [0.0] * len(v)), "row 11 is 0.44 s off"),
        (_rows("length", lambda v: [12, 0], EPISODES), "has 0 rows"),
        (_rows("episode_index", lambda v: [1, 1], EPISODES), "lists episode 1 2 times"),
        (_rows(BEGIN, lambda v: [0.0, np.nan], EPISODES), "from_timestamp is nan"),
        (_table(lambda t: t.take([0] * 100_001), EPISODES), "has 100001 rows, more than 100000"),
        (_table(lambda table: table.drop_columns(["action"])), "lacks .*action"),
        (_table(lambda table: table.slice(0, 15)), "holds 3 rows"),
        (_column("observation.state", pa.array(np.zeros(20, "f4"))), "13 numbers a row"),
        (lambda root: (root / ROWS).unlink(), "is not there"),
        (lambda root: (root / EPISODES).unlink(), "no meta/episodes"),
    ],
)
def test_another_kind_of_dataset_or_a_damaged_one_is_refused(spoil, says, tmp_path):
    spoil(write(tmp_path / "a"))
    with pytest.raises(DatasetError, match=says):
        read_dataset(tmp_path / "a")


def test_a_video_that_ends_early_is_refused(tmp_path: Path) -> None:
    root = write(tmp_path / "a")
    encode(root / VIDEO, ALL_IMAGES[:14])
    first, second = read_dataset(root)
    assert len(list(first.decode())) == LENGTHS[0]
    with pytest.raises(DatasetError, match="ends after 2 of 8"):
        list(second.decode())


def huge_png() -> bytes:
    """Return a picture of one pixel whose header says 60,000 x 60,000."""
    header = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    small = cv2.imencode(".png", np.zeros((1, 1, 3), np.uint8))[1].tobytes()
    return small[:12] + header + struct.pack(">I", zlib.crc32(header)) + small[33:]


@pytest.mark.parametrize(
    ("encoded", "says"),
    [
        (None, r"not in the table, .* alone \(2\.png\)"),
        (b"", "not a PNG"),
        (huge_png(), "not a PNG"),
    ],
)
def test_an_image_that_cannot_be_used_is_named(encoded, says, tmp_path: Path) -> None:
    root = write(tmp_path / "a", kind="image")
    _rows(CAMERA, lambda cells: [*cells[:2], {"bytes": encoded, "path": "2.png"}, *cells[3:]])(root)
    with pytest.raises(DatasetError, match=f"episode 0: the image of row 2 is {says}"):
        list(read_dataset(root)[0].decode())
