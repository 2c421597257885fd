"""Drafts of contract files from LeRobot's folders: datasets, and policies trained on them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from policy import files
from policy.adapters.drafts.entries import (
    Entry,
    action_entries,
    camera_entries,
    frame_entry,
    rate_entry,
    state_entries,
)
from policy.adapters.lerobot.config import CONFIG_FILE, read_json
from policy.contract import ACTION_DIM
from policy.data.lerobot_format import ACTION_KEY, INFO, STATE_FRAME, STATE_KEY, STATS
from policy.errors import CheckpointError

TRAIN_CONFIG_FILE = "train_config.json"


@dataclass(frozen=True, kw_only=True)
class _Vectors:
    """What a folder says of state and action, and of the images' keys."""

    state_dim: int
    action_dim: int
    image_keys: Sequence[str]


def dataset_entries(folder: Path) -> list[Entry]:
    """All that a dataset (v2 or v3) says: names, rate, cameras, and axes if it is one of ours."""
    info = read_json(folder / INFO)
    features = _table(folder / INFO, info, "features")
    images = [key for key, value in features.items() if value.get("dtype") in ("video", "image")]
    vectors = _Vectors(
        state_dim=_width(features.get(STATE_KEY)),
        action_dim=_width(features.get(ACTION_KEY)),
        image_keys=sorted(images),
    )
    return _entries(vectors, folder / INFO, folder)


def checkpoint_entries(folder: Path, dataset: Path | None) -> list[Entry]:
    """All that a policy's folder says: shapes; and of the dataset, if there is one, the rest."""
    path = folder / CONFIG_FILE
    config = read_json(path)
    inputs, outputs = (
        _table(path, config, "input_features"),
        _table(path, config, "output_features"),
    )
    images = [key for key, value in inputs.items() if value.get("type") == "VISUAL"]
    vectors = _Vectors(
        state_dim=_width(inputs.get(STATE_KEY)),
        action_dim=_width(outputs.get(ACTION_KEY)),
        image_keys=images,
    )
    return _entries(vectors, path, dataset)


def dataset_of(checkpoint: Path) -> Path | None:
    """The dataset that LeRobot's training noted beside a policy, if it is on this machine."""
    try:
        noted = files.read_json(checkpoint / TRAIN_CONFIG_FILE)["dataset"]
        home = Path.home() / ".cache" / "huggingface" / "lerobot"  # LeRobot's own default
        folder = Path(noted["root"]) if noted.get("root") else home / str(noted["repo_id"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return folder if (folder / INFO).is_file() else None


def _entries(vectors: _Vectors, path: Path, dataset: Path | None) -> list[Entry]:
    if vectors.action_dim != ACTION_DIM:
        raise CheckpointError(
            f"{path}: its action has {vectors.action_dim} numbers, but {ACTION_DIM} fly a "
            "multirotor: sticks, or thrust and rates, or thrust and attitude, or a velocity"
        )
    names: dict[str, list[str] | None] = {STATE_KEY: None, ACTION_KEY: None}
    rate_hz, where, frame = None, path.name, frame_entry(None, "to answer", "")
    if dataset is not None:
        info, where = read_json(dataset / INFO), f"the dataset's {INFO}"
        features = _table(dataset / INFO, info, "features")
        names = {key: _names(features.get(key)) for key in names}
        fps = info.get("fps")
        rate_hz = float(fps) if isinstance(fps, int | float) else None
        frame = _frame(dataset, features, names[STATE_KEY])
    return [
        rate_entry(rate_hz, where),
        frame,
        *action_entries(names[ACTION_KEY], where),
        *state_entries(names[STATE_KEY], vectors.state_dim, where),
        *camera_entries(vectors.image_keys, path.name),
    ]


def _frame(dataset: Path, features: Mapping[str, Any], names: Sequence[str] | None) -> Entry:
    """As our export notes it; else by gravity: in level flight -z is up in FRD, +z in FLU."""
    about = features.get(STATE_KEY, {}).get("info")
    if isinstance(about, dict) and STATE_FRAME in about:
        return frame_entry(str(about[STATE_FRAME]), "read", f"the dataset's {INFO}")
    try:
        stats = files.read_json(dataset / STATS)
        mean = float(stats[STATE_KEY]["mean"][list(names or ()).index("az_mps2")])
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return frame_entry(None, "to answer", "")
    frame = "ned_frd" if mean < 0 else "enu_flu"
    return frame_entry(frame, "guessed", f"the mean of az_mps2 is {mean:.1f}, by {STATS}")


def _names(feature: object) -> list[str] | None:
    names = feature.get("names") if isinstance(feature, dict) else None
    if isinstance(names, dict) and len(names) == 1:  # {"motors": [...]}, as older datasets have it
        names = next(iter(names.values()))
    return [str(name) for name in names] if isinstance(names, list) else None


def _width(feature: object) -> int:
    shape = feature.get("shape") if isinstance(feature, dict) else None
    is_vector = isinstance(shape, list) and len(shape) == 1 and isinstance(shape[0], int)
    return int(shape[0]) if is_vector and shape else 0


def _table(path: Path, data: Mapping[str, Any], name: str) -> dict[str, dict[str, Any]]:
    table = data.get(name)
    if not isinstance(table, dict) or not all(isinstance(v, dict) for v in table.values()):
        raise CheckpointError(f"{path}: {name} must be an object of features, got {table!r}")
    return table
