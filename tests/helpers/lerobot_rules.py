"""Assumptions of lerobot 0.6.1 about a dataset of format v3.0.

Each rule names the file and line of ``src/lerobot`` that breaks without it. lerobot itself cannot
be imported beside this project's torch (it needs torchvision, and torch < 2.12).
"""

import json
from collections import Counter
from pathlib import Path
from typing import Any

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

TOLERANCE_S = 1e-4
"""datasets/lerobot_dataset.py:55"""
DEFAULT_FEATURES = {  # utils/constants.py:81-87
    "timestamp": "float32",
    **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), "int64"),
}


def require_readable(root: Path) -> None:
    """Fail if a dataset breaks a rule."""
    info = json.loads((root / "meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"  # datasets/utils.py:304
    assert isinstance(info["fps"], int)  # datasets/utils.py:125, 156
    assert info["fps"] > 0
    assert info["splits"] == {"train": f"0:{info['total_episodes']}"}  # dataset_metadata.py:676
    # utils/feature_utils.py:168-172: these names become inputs and outputs of a policy
    taken = {name for name in info["features"] if name.startswith(("observation", "action"))}
    assert taken == {"observation.images.front", "observation.state", "action"}
    episodes, rows = (_joined(root / folder) for folder in ("meta/episodes", "data"))
    _require_columns(info["features"], rows)
    _require_places(info, episodes, rows)
    _require_tasks(root, info, rows)
    _require_videos(root, info, episodes.to_pylist(), rows)
    _require_statistics(root, info["features"], episodes.to_pylist())


def _joined(folder: Path) -> pa.Table:
    """Join in the order of datasets/io_utils.py:75, which is that of the names."""
    return pa.concat_tables([pq.read_table(path) for path in sorted(folder.glob("*/*.parquet"))])


def _require_columns(features: dict[str, Any], rows: pa.Table) -> None:
    for name, dtype in DEFAULT_FEATURES.items():
        assert features[name] == {"dtype": dtype, "shape": [1], "names": None}, name
    stored = [name for name, feature in features.items() if feature["dtype"] != "video"]
    assert rows.column_names == stored  # datasets/feature_utils.py:64: videos have no column
    for name in stored:
        dtype = {"float32": pa.float32(), "int64": pa.int64()}[features[name]["dtype"]]
        width = features[name]["shape"][0]
        wanted = dtype if width == 1 else pa.list_(dtype, width)  # feature_utils.py:67-73
        assert (rows.schema.field(name).type, rows[name].null_count) == (wanted, 0), name


def _require_places(info: dict[str, Any], episodes: pa.Table, rows: pa.Table) -> None:
    lengths = episodes["length"].to_numpy()
    ends, frames = np.cumsum(lengths), np.concatenate([np.arange(count) for count in lengths])
    assert (info["total_frames"], info["total_episodes"]) == (rows.num_rows, len(lengths))
    wanted_rows = {
        "index": np.arange(rows.num_rows),  # dataset_reader.py:223: rows by absolute index
        "episode_index": np.repeat(np.arange(len(lengths)), lengths),
        "frame_index": frames,
        "timestamp": (frames / info["fps"]).astype(np.float32),  # dataset_writer.py:225
    }
    wanted_episodes = {  # dataset_reader.py:218-228: by position
        "episode_index": np.arange(len(lengths)),
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
    }
    for table, wanted in ((rows, wanted_rows), (episodes, wanted_episodes)):
        for name, values in wanted.items():
            np.testing.assert_array_equal(table[name].to_numpy(), values, name)


def _require_tasks(root: Path, info: dict[str, Any], rows: pa.Table) -> None:
    table = pq.read_table(root / "meta/tasks.parquet")
    pandas = json.loads((table.schema.metadata or {}).get(b"pandas", b"{}"))
    # io_utils.py:184, dataset_reader.py:352: the texts are pandas' index, selected by position
    assert pandas.get("index_columns") == ["task"]
    assert pa.types.is_string(table["task"].type)
    assert table["task_index"].to_pylist() == list(range(info["total_tasks"]))
    assert set(rows["task_index"].to_pylist()) <= set(table["task_index"].to_pylist())


def _require_videos(
    root: Path, info: dict[str, Any], episodes: list[dict[str, Any]], rows: pa.Table
) -> None:
    used: Counter[Path] = Counter()
    for key in [name for name, each in info["features"].items() if each["dtype"] == "video"]:
        for episode in episodes:
            video = _below(f"videos/{key}/", episode)
            path = root / info["video_path"].format(  # dataset_metadata.py: get_video_file_path
                video_key=key, chunk_index=video["chunk_index"], file_index=video["file_index"]
            )
            part = rows.slice(episode["dataset_from_index"], episode["length"])
            # dataset_reader.py:278-279
            asked_s = video["from_timestamp"] + part["timestamp"].to_numpy().astype(float)
            used[path] += len(asked_s)
            _require_found(path, asked_s)
            end_s = video["from_timestamp"] + episode["length"] / info["fps"]
            assert abs(video["to_timestamp"] - end_s) <= TOLERANCE_S
    for path, count in used.items():
        assert len(_pts(path)[0]) == count, path


def _pts(path: Path) -> tuple[np.ndarray, float]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        pts = [float(frame.pts * stream.time_base) for frame in container.decode(stream)]
        return np.array(pts), float(stream.average_rate)


def _require_found(path: Path, asked_s: np.ndarray) -> None:
    """Check that both decoders of lerobot find frame k where row k asks for it."""
    pts_s, average_fps = _pts(path)
    shown, wanted = pts_s.astype(np.float32), asked_s.astype(np.float32)
    nearest = np.abs(shown[:, None] - wanted).min(axis=0)
    assert nearest.max() < TOLERANCE_S, path  # PyAV: video_utils.py:158-193
    places = [round(at * average_fps) for at in asked_s]  # torchcodec: video_utils.py:387-404
    assert max(places) < len(shown), path
    assert np.abs(shown[places] - wanted).max() < TOLERANCE_S, path


def _require_statistics(
    root: Path, features: dict[str, Any], episodes: list[dict[str, Any]]
) -> None:
    stats = json.loads((root / "meta/stats.json").read_text())
    for name, feature in features.items():
        # compute_stats.py:547-561
        shape = (3, 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
        for of in (stats[name], *(_below(f"stats/{name}/", episode) for episode in episodes)):
            assert {"min", "max", "mean", "std", "count"} <= set(of), name
            for kind, values in of.items():
                assert np.shape(values) == ((1,) if kind == "count" else shape), (name, kind)


def _below(prefix: str, episode: dict[str, Any]) -> dict[str, Any]:
    """Return the columns of an episode that begin with this, by the rest of their names."""
    return {k.removeprefix(prefix): v for k, v in episode.items() if k.startswith(prefix)}
