"""Assumptions of lerobot 0.6.1 about a dataset of format v3.0.

Each rule names the file and line of ``src/lerobot`` that breaks without it. lerobot itself cannot
be imported beside this project's torch (it needs torchvision, and torch < 2.12).
"""

import json
from collections.abc import Iterator
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


def broken_rules(root: Path) -> list[str]:
    """Return all rules that a dataset breaks, in words."""
    info = json.loads((root / "meta/info.json").read_text())
    episodes = _concatenated(root / "meta/episodes")
    rows = _concatenated(root / "data")
    checks = (
        _info(info),
        _features(info, rows),
        _rows(info, episodes, rows),
        _tasks(root, info, rows),
        _videos(root, info, episodes, rows),
        _stats(root, info),
        _policy_features(info),
    )
    return [broken for check in checks for broken in check]


def _concatenated(folder: Path) -> pa.Table:
    """Join in the order of datasets/io_utils.py:75, which is that of the names."""
    return pa.concat_tables([pq.read_table(path) for path in sorted(folder.glob("*/*.parquet"))])


def _info(info: dict[str, Any]) -> Iterator[str]:
    if info["codebase_version"] != "v3.0":  # datasets/utils.py:304 check_version_compatibility
        yield f"codebase_version {info['codebase_version']}"
    if not isinstance(info["fps"], int) or info["fps"] <= 0:  # datasets/utils.py:125, 156
        yield f"fps {info['fps']}"
    if info["splits"] != {"train": f"0:{info['total_episodes']}"}:  # dataset_metadata.py:676
        yield f"splits {info['splits']}"


def _features(info: dict[str, Any], rows: pa.Table) -> Iterator[str]:
    features = info["features"]
    for name, dtype in DEFAULT_FEATURES.items():
        if features.get(name) != {"dtype": dtype, "shape": [1], "names": None}:
            yield f"default feature {name}"
    stored = [name for name, feature in features.items() if feature["dtype"] != "video"]
    if rows.column_names != stored:  # datasets/feature_utils.py:64: videos have no column
        yield f"columns {rows.column_names}"
    for name in set(stored) & set(rows.column_names):
        dtype = {"float32": pa.float32(), "int64": pa.int64()}[features[name]["dtype"]]
        width = features[name]["shape"][0]
        wanted = dtype if width == 1 else pa.list_(dtype, width)  # feature_utils.py:67-73
        if not rows.schema.field(name).type.equals(wanted) or rows[name].null_count:
            yield f"type of {name}: {rows.schema.field(name).type}"


def _rows(info: dict[str, Any], episodes: pa.Table, rows: pa.Table) -> Iterator[str]:
    lengths = episodes["length"].to_numpy()
    ends, frames = np.cumsum(lengths), np.concatenate([np.arange(count) for count in lengths])
    if (info["total_frames"], info["total_episodes"]) != (rows.num_rows, len(lengths)):
        yield "totals"
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
    for what, table, wanted in (
        ("rows", rows, wanted_rows),
        ("episodes", episodes, wanted_episodes),
    ):
        for name, values in wanted.items():
            if not np.array_equal(table[name].to_numpy(), values):
                yield f"{name} of the {what}"


def _tasks(root: Path, info: dict[str, Any], rows: pa.Table) -> Iterator[str]:
    table = pq.read_table(root / "meta/tasks.parquet")
    pandas = json.loads((table.schema.metadata or {}).get(b"pandas", b"{}"))
    # io_utils.py:184, dataset_reader.py:352: the texts are pandas' index, selected by position
    if pandas.get("index_columns") != ["task"] or not pa.types.is_string(table["task"].type):
        yield "tasks are not the index"
    if table["task_index"].to_pylist() != list(range(info["total_tasks"])):
        yield "task_index is not the place of the task"
    if not set(rows["task_index"].to_pylist()) <= set(table["task_index"].to_pylist()):
        yield "a row of an unknown task"


def _videos(root: Path, info: dict[str, Any], episodes: pa.Table, rows: pa.Table) -> Iterator[str]:
    keys = [name for name, feature in info["features"].items() if feature["dtype"] == "video"]
    used = {}
    for key in keys:
        for episode in episodes.to_pylist():
            prefix = f"videos/{key}/"
            path = root / info["video_path"].format(  # dataset_metadata.py: get_video_file_path
                video_key=key,
                chunk_index=episode[f"{prefix}chunk_index"],
                file_index=episode[f"{prefix}file_index"],
            )
            if not path.is_file():  # dataset_reader.py:185-200
                yield f"{path.name} of episode {episode['episode_index']} is missing"
                continue
            pts_s, average_fps = _pts(path)
            part = rows.slice(episode["dataset_from_index"], episode["length"])
            # dataset_reader.py:278-279
            asked = episode[f"{prefix}from_timestamp"] + part["timestamp"].to_numpy().astype(float)
            used[path] = used.get(path, 0) + len(asked)
            yield from _found(path, asked, pts_s, average_fps)
            end = episode[f"{prefix}from_timestamp"] + episode["length"] / info["fps"]
            if abs(episode[f"{prefix}to_timestamp"] - end) > TOLERANCE_S:
                yield f"to_timestamp of episode {episode['episode_index']}"
    for path, count in used.items():
        if count != len(_pts(path)[0]):
            yield f"{path.name} has {len(_pts(path)[0])} frames, {count} rows"


def _pts(path: Path) -> tuple[np.ndarray, float]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        pts = [float(frame.pts * stream.time_base) for frame in container.decode(stream)]
        return np.array(pts), float(stream.average_rate)


def _found(path: Path, asked: np.ndarray, pts_s: np.ndarray, average_fps: float) -> Iterator[str]:
    """Check that both decoders of lerobot find frame k where row k asks for it."""
    wanted = asked.astype(np.float32)
    nearest = np.abs(pts_s.astype(np.float32)[:, None] - wanted).min(axis=0)
    if not (nearest < TOLERANCE_S).all():  # PyAV: video_utils.py:158-193
        yield f"{path.name}: no frame within {TOLERANCE_S} s of {asked[nearest.argmax()]}"
    place = np.array(
        [round(at * average_fps) for at in asked]
    )  # torchcodec: video_utils.py:387-404
    if place.max() >= len(pts_s):
        yield f"{path.name}: ends before row {int(place.argmax())}"
    elif not (np.abs(pts_s[place].astype(np.float32) - wanted) < TOLERANCE_S).all():
        yield f"{path.name}: another frame at its average rate {average_fps}"


def _stats(root: Path, info: dict[str, Any]) -> Iterator[str]:
    stats = json.loads((root / "meta/stats.json").read_text())
    episodes = _concatenated(root / "meta/episodes").to_pylist()
    for name, feature in info["features"].items():
        for of in (stats.get(name, {}), *(_of_episode(e, name) for e in episodes)):
            if not {"min", "max", "mean", "std", "count"} <= set(of):
                yield f"stats of {name}: {sorted(of)}"
                continue
            # compute_stats.py:547-561
            shape = (3, 1, 1) if feature["dtype"] == "video" else tuple(feature["shape"])
            for kind, values in of.items():
                if np.shape(values) != ((1,) if kind == "count" else shape):
                    yield f"stats of {name}: {kind} has shape {np.shape(values)}"


def _of_episode(episode: dict[str, Any], name: str) -> dict[str, Any]:
    prefix = f"stats/{name}/"
    return {k.removeprefix(prefix): v for k, v in episode.items() if k.startswith(prefix)}


def _policy_features(info: dict[str, Any]) -> Iterator[str]:
    """Check utils/feature_utils.py:168-172: these names become inputs and outputs of a policy."""
    taken = {n for n in info["features"] if n.startswith(("observation", "action"))}
    if taken != {"observation.images.front", "observation.state", "action"}:
        yield f"a policy would take {sorted(taken)}"
