"""First drafts of contract files: read entries, guessed entries, and questions to the user.

A draft is TOML for ``interface.read_interface``. A comment at each entry names the source of its
value. An entry that only the user can answer holds ``interface.UNANSWERED``.
"""

import json
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from policy import files
from policy.adapters.description import read_graph
from policy.adapters.interface import ACTION_FIELDS, DERIVED_NAMES, is_unanswered
from policy.adapters.lerobot.config import CONFIG_FILE, read_json
from policy.contract import (
    ACTION_DIM,
    IMAGENET_MEAN_RGB,
    IMAGENET_STD_RGB,
    LIMIT_TERMS,
    STATE_NAMES,
    STICK_TERMS,
    Contract,
)
from policy.data.lerobot_format import (
    ACTION_KEY,
    INFO,
    STATE_KEY,
    STATS,
    feature_names,
    frame_by_gravity,
    noted_frame,
)
from policy.errors import CheckpointError
from policy.files import UNANSWERED

Table = Literal["contract", "state", "action", "images", "task"]
TRAIN_CONFIG_FILE = "train_config.json"
_WIDTH = 96
_MAX_STATE = 1000
_HOVER = "hover_thrust"
_SPELLINGS: Mapping[str, Sequence[str]] = {
    "vx_mps": ("vx", "vel_x", "velocity_x"),
    "vy_mps": ("vy", "vel_y", "velocity_y"),
    "vz_mps": ("vz", "vel_z", "velocity_z"),
    "qw": ("quat_w", "q_w", "orientation_w"),
    "qx": ("quat_x", "q_x", "orientation_x"),
    "qy": ("quat_y", "q_y", "orientation_y"),
    "qz": ("quat_z", "q_z", "orientation_z"),
    "wx_radps": ("wx", "rollspeed", "roll_rate", "angular_velocity_x", "gyro_x"),
    "wy_radps": ("wy", "pitchspeed", "pitch_rate", "angular_velocity_y", "gyro_y"),
    "wz_radps": ("wz", "yawspeed", "yaw_rate", "angular_velocity_z", "gyro_z"),
    "ax_mps2": ("ax", "acc_x", "accel_x", "linear_acceleration_x"),
    "ay_mps2": ("ay", "acc_y", "accel_y", "linear_acceleration_y"),
    "az_mps2": ("az", "acc_z", "accel_z", "linear_acceleration_z"),
    "roll_rad": ("roll",),
    "pitch_rad": ("pitch",),
    "yaw_rad": ("yaw", "heading"),
}
"""Common spellings of state names in other projects; their units are guessed."""


class Entry(NamedTuple):
    """A line of a draft."""

    table: Table
    name: str
    value: Any
    """Text, number, or list of either."""
    why: str
    """Source of the value, or the question to the user."""
    found: Literal["read", "guessed", "optional"] = "read"
    """Optional entries are written as comments."""

    @property
    def origin(self) -> str:
        """Return "to answer" for an open question, else ``found``."""
        return "to answer" if is_unanswered(self.value) else self.found


_ASKED_RATE = Entry(
    *("contract", "chunk_dt_s", UNANSWERED),
    "seconds from one action of a chunk to the next: 1 / frames a second of its dataset",
)
_ASKED_FRAME = Entry(
    *("contract", "state_frame", UNANSWERED),
    "axes of its state and action: ned_frd (z down, as MAVLink) or enu_flu (z up, as ROS)",
)


def draft_text(title: str, entries: Sequence[Entry]) -> str:
    """Return a contract file headed by ``title``; a comment above each entry names its source."""
    lines = _comment(title)
    for table in ("contract", "state", "action", "images", "task"):
        inside = [entry for entry in entries if entry.table == table]
        if inside:
            lines += ["", f"[{table}]"]
        said: list[str] = []
        for entry in inside:
            comment = _comment(f"{entry.origin.upper()}: {entry.why}")
            lines += comment if comment != said else []
            said = comment
            # JSON strings, numbers and lists are valid TOML, but not JSON's pairs of surrogates.
            line = f"{entry.name} = {json.dumps(entry.value, ensure_ascii=False)}"
            lines.append(f"# {line}" if entry.origin == "optional" else line)
    return "\n".join(lines) + "\n"


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, _WIDTH, initial_indent="# ", subsequent_indent="# ")


# --- LeRobot's folders: datasets, and policies trained on them


def dataset_entries(folder: Path) -> list[Entry]:
    """Draft from a dataset (v2, v3): names, rate, cameras; the frame if mavbridge exported it."""
    path = folder / INFO
    features = _features(path, read_json(path), "features")
    images = [key for key, value in features.items() if value.get("dtype") in ("video", "image")]
    dims = _width(features.get(STATE_KEY)), _width(features.get(ACTION_KEY))
    return _lerobot_entries(*dims, sorted(images), path, folder)


def checkpoint_entries(folder: Path, dataset: Path | None) -> list[Entry]:
    """Draft from a policy's shapes, and from the names and rate of its dataset if there is one."""
    path = folder / CONFIG_FILE
    config = read_json(path)
    inputs, outputs = (
        _features(path, config, name) for name in ("input_features", "output_features")
    )
    images = [key for key, value in inputs.items() if value.get("type") == "VISUAL"]
    dims = _width(inputs.get(STATE_KEY)), _width(outputs.get(ACTION_KEY))
    return _lerobot_entries(*dims, images, path, dataset)


def dataset_of(checkpoint: Path) -> Path | None:
    """Return the dataset that LeRobot's training recorded beside a policy, if it is present."""
    try:
        noted = files.read_json(checkpoint / TRAIN_CONFIG_FILE)["dataset"]
        home = Path.home() / ".cache" / "huggingface" / "lerobot"  # LeRobot's own default
        folder = Path(noted["root"]) if noted.get("root") else home / str(noted["repo_id"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return folder if (folder / INFO).is_file() else None


def _lerobot_entries(
    state_dim: int, action_dim: int, image_keys: Sequence[str], path: Path, dataset: Path | None
) -> list[Entry]:
    if action_dim != ACTION_DIM:
        raise CheckpointError(
            f"{path}: its action has {action_dim} numbers, but {ACTION_DIM} fly a "
            "multirotor: sticks, or thrust and rates, or thrust and attitude, or a velocity"
        )
    names: dict[str, list[str] | None] = {STATE_KEY: None, ACTION_KEY: None}
    rate, frame, where = _ASKED_RATE, _ASKED_FRAME, path.name
    if dataset is not None:
        info, where = read_json(dataset / INFO), f"the dataset's {INFO}"
        features = _features(dataset / INFO, info, "features")
        names = {key: feature_names(features.get(key)) for key in names}
        fps = info.get("fps")
        if isinstance(fps, int | float) and fps >= 1:
            why = f"{where}: {fps:g} a second"
            rate = Entry("contract", "chunk_dt_s", round(1 / fps, 6), why)
        frame = _frame(dataset, features, names[STATE_KEY])
    return [
        rate,
        frame,
        *_action_entries(names[ACTION_KEY], where),
        *_state_entries(names[STATE_KEY], state_dim, where),
        *_camera_entries(image_keys, path.name),
    ]


def _frame(dataset: Path, features: Mapping[str, Any], names: Sequence[str] | None) -> Entry:
    """Return the frame that mavbridge's export noted; else tell it by gravity."""
    if (noted := noted_frame(features.get(STATE_KEY, {}))) is not None:
        return Entry("contract", "state_frame", str(noted), f"the dataset's {INFO}")
    try:
        stats = files.read_json(dataset / STATS)
        mean = float(stats[STATE_KEY]["mean"][list(names or ()).index("az_mps2")])
    except (OSError, ValueError, KeyError, IndexError, TypeError):
        return _ASKED_FRAME
    if (frame := frame_by_gravity(mean)) is None:
        return _ASKED_FRAME
    why = f"the mean of az_mps2 is {mean:.1f}, by {STATS}"
    return Entry("contract", "state_frame", frame, why, "guessed")


def _width(feature: object) -> int:
    match feature:
        case {"shape": [int(width)]}:
            return width
    return 0


def _features(path: Path, data: Mapping[str, Any], name: str) -> dict[str, dict[str, Any]]:
    table = data.get(name)
    if not isinstance(table, dict) or not all(isinstance(v, dict) for v in table.values()):
        raise CheckpointError(f"{path}: {name} must be an object of features, got {table!r}")
    return table


# --- ONNX: names and sizes of inputs and outputs


class _Port(NamedTuple):
    """Input or output of a graph."""

    name: str
    where: str
    shape: tuple[int | None, ...]
    """None for an axis of unknown size."""


def onnx_files(source: Path) -> list[Path]:
    """Return the graphs of a file or folder; empty if it is neither."""
    if source.is_dir():
        return sorted(source.glob("*.onnx"))
    return [source] if source.suffix.lower() == ".onnx" and source.is_file() else []


def onnx_entries(graphs: Sequence[Path]) -> list[Entry]:
    """Draft from graphs: names and sizes of image, state, history and chunk."""
    inputs, outputs = _ports(graphs)
    given = [port.shape for port in outputs]  # an input shaped like an output is a hidden state
    planes = [port for port in inputs if len(port.shape) >= 4]
    images = [port for port in planes if port.shape[-3] in (1, 3)]
    for port in planes:
        if not images and port.shape not in given and port.shape[-1] in (1, 3):
            raise CheckpointError(f"{port.where} has its channels last: export it as [1, C, H, W]")
    histories = [port for port in inputs if "history" in port.name and len(port.shape) >= 2]
    others = [
        port
        for port in inputs
        if port not in images + histories and len(port.shape) >= 2 and port.shape not in given
    ]
    states = [port for port in others if "state" in port.name] or others
    chunks = [port for port in outputs if port.shape[-1:] == (ACTION_DIM,) and len(port.shape) > 1]
    entries = [_ASKED_RATE, _ASKED_FRAME, *_action_entries(None, "")]
    for name, ports, axis in (
        ("image_height", images, -2),
        ("image_width", images, -1),
        ("history_len", histories, -2),
        ("horizon", chunks, -2),
    ):
        for port in ports[:1]:
            size = port.shape[axis]
            why = port.where if size else f"{port.where} leaves its size open"
            entries.append(Entry("contract", name, size or UNANSWERED, why))
    for port in images[:1]:
        entries += _pixel_entries(port.shape[-3] == 1)
        entries += _camera_entries([port.name], port.where)
    for port in states[:1]:
        entries.append(Entry("state", "key", port.name, port.where))
        entries += _state_entries(None, port.shape[-1] or 0, port.where)
    return entries


def _pixel_entries(is_depth: bool) -> list[Entry]:
    if is_depth:
        why = "it takes one channel: depth in metres, 0 where it is not known"
        return [Entry("contract", "image_channels", "depth", why, "guessed")]
    why = "it takes (rgb / 255 - mean) / std; zeros and ones for images in [0, 1]"
    scaling = (("image_mean_rgb", IMAGENET_MEAN_RGB), ("image_std_rgb", IMAGENET_STD_RGB))
    return [Entry("contract", name, list(value), why, "guessed") for name, value in scaling]


def _ports(graphs: Sequence[Path]) -> tuple[list[_Port], list[_Port]]:
    """Return the inputs and outputs of all graphs."""
    found: dict[str, list[_Port]] = {"input": [], "output": []}
    for file in graphs:
        model = read_graph(file)
        for kind, ports in (("input", model.inputs), ("output", model.outputs)):
            for port in ports:
                name = min(port.get_names(), default="")
                sizes = port.get_partial_shape()
                shape = tuple(size.get_length() if size.is_static else None for size in sizes)
                found[kind].append(_Port(name, f"{kind} {name} of {file.name}", shape))
    return found["input"], found["output"]


# --- Recorded flights


def recorded_entries(contracts: Sequence[Contract]) -> list[Entry]:
    """Draft the terms that all flights share, and ask for the terms that differ between flights.

    Limits go into a draft only if the flights' values differ from the defaults.
    """
    entries = []
    for name in (*STICK_TERMS, *LIMIT_TERMS):
        values = {getattr(each, name) for each in contracts}
        value = getattr(contracts[0], name)
        if len(values) > 1:
            found = ", ".join(sorted(map(json.dumps, values)))
            why = f"the flights were flown with different ones: {found}"
            entries.append(Entry("contract", name, UNANSWERED, why))
        elif name in STICK_TERMS or value != getattr(Contract(), name):
            entries.append(Entry("contract", name, value, "as the flights were flown"))
    return entries


# --- Entries shared by all drafts


def _state_entries(names: Sequence[str] | None, dim: int, where: str) -> list[Entry]:
    """Draft the state's names: known, guessed from their spelling, or asked for."""
    if dim == 0:
        return []
    if not 1 <= dim <= _MAX_STATE:
        raise CheckpointError(f"{where}: a state must have 1 to {_MAX_STATE} numbers, got {dim}")
    known = (*STATE_NAMES, *DERIVED_NAMES)
    guesses = {other: name for name, others in _SPELLINGS.items() for other in others}
    given = list(names) if names is not None and len(names) == dim else [""] * dim
    found = [name if name in known else guesses.get(name.lower(), UNANSWERED) for name in given]
    called = f"{where} calls them {', '.join(given)}"
    if UNANSWERED in found:
        why = f"names of its {dim} numbers in their order, of {', '.join(known)}"
        why += f"; {called}" if any(given) else ""
    else:
        why = where if found == given else f"{called}; are these its units, and its axes?"
    factor = "factor from the units above to the policy's, e.g. 57.29578 for degrees"
    return [
        Entry("state", "names", found, why, "read" if found == given else "guessed"),
        Entry("state", "scale", [1.0] * dim, factor, "optional"),
    ]


def _gain_entries(kind: str) -> list[Entry]:
    """Draft what no file tells of an action kind's training."""
    known = {"sticks": STICK_TERMS[1:], "velocity": (), UNANSWERED: (*STICK_TERMS[1:], _HOVER)}
    why = "what full sticks did, or which thrust hovered, in training; these are our defaults"
    found: Literal["optional", "guessed"] = "optional" if kind == UNANSWERED else "guessed"
    terms, usual = known.get(kind, (_HOVER,)), Contract()
    return [Entry("contract", term, getattr(usual, term), why, found) for term in terms]


def _action_entries(names: Sequence[str] | None, where: str) -> list[Entry]:
    """Draft the action kind, its gains and the action's names: known, or asked for."""
    kinds = [kind for kind, own in ACTION_FIELDS.items() if sorted(own) == sorted(names or ())]
    if kinds and names:
        return [
            Entry("contract", "action", kinds[0], where),
            *_gain_entries(kinds[0]),
            Entry("action", "names", list(names), where),
        ]
    choices = "; ".join(f"{kind}: {', '.join(own)}" for kind, own in ACTION_FIELDS.items())
    called = f"; {where} calls them {', '.join(names)}" if names else ""
    asked = f"what its four actions are. {choices}{called}"
    order = "the four names of that kind, in the policy's order"
    units = "from the policy's units to those of the names"
    factor = f"{units}: a factor, e.g. -1.0 for another sign"
    return [
        Entry("contract", "action", UNANSWERED, asked),
        *_gain_entries(UNANSWERED),
        Entry("action", "names", [UNANSWERED] * 4, order),
        Entry("action", "scale", [1.0] * 4, factor, "optional"),
        Entry("action", "offset", [0.0] * 4, f"{units}: added after the factor", "optional"),
    ]


def _camera_entries(keys: Sequence[str], where: str) -> list[Entry]:
    """Draft the policy's name of each camera."""
    cameras = ["front"] if len(keys) == 1 else [key.rpartition(".")[2] for key in keys]
    is_bare = all(name.isidentifier() and name.isascii() for name in cameras)
    if len(set(cameras)) < len(keys) or not is_bare:
        cameras = [f"camera_{number}" for number in range(len(keys))]
    why = "names of the vehicle's cameras; with several, those that --camera gives them"
    images = [
        Entry("images", camera, key, where) for camera, key in zip(cameras, keys, strict=True)
    ]
    return [Entry("contract", "cameras", cameras, why, "guessed"), *images] if images else []
