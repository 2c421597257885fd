"""Format detection of weight files, and the header of ours; needs neither torch nor the weights.

Faults of a file are raised as ``CheckpointError``.
"""

import json
import struct
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from policy.contract import Contract
from policy.errors import CheckpointError, ContractError
from policy.files import open_regular, open_safetensors, read_json, stand_in_of

HEAD_BYTES = 4096
MAX_HEADER_BYTES = 100_000_000
"""Longest header of safetensors, as in its own reader."""
LEROBOT_TYPES = ("act", "diffusion")
"""Types of LeRobot policies that fly from their files."""
_FOLDERS: tuple[tuple[str, str, str], ...] = (
    *(
        (sign, "a folder of LeRobot's training", "fly it with --policy lerobot:{0}/{1}")
        for sign in ("pretrained_model/", "checkpoints/last/pretrained_model/")
    ),
    ("meta/info.json", "a LeRobot data set, not a policy", "train one: mavbridge train {0}"),
    ("ticks.parquet", "a recorded flight, not a policy", "train one: mavbridge train {0}"),
    ("*.onnx", "a folder of ONNX models", "fly it with --policy onnx:{0}"),
)
"""Entry of a folder, the folder's kind, and the next step."""
_ARCHIVES = {
    "archive_format": "a program of torch.export",
    "_stable_baselines3_version": "a model of Stable-Baselines3",
}
"""File in a zip archive, and the archive's kind."""
CONTRACT_KEY = "contract"
ARCHITECTURE_KEY = "architecture"
TRAINING_KEY = "training"
HEADER_KEYS = (CONTRACT_KEY, ARCHITECTURE_KEY)
SUFFIXES = (".safetensors", ".pt", ".pth", ".ckpt")


def detect(path: Path) -> str | None:
    """Return the kind of a file or folder and how to fly it; None: unknown, or may be ours."""
    try:
        found = _folder(path) if path.is_dir() else _file(path)
    except OSError:
        return None  # the error of opening it says why
    if found is None:
        return None
    what, advice = found
    return f"{path} is {what}: {advice}"


def _file(path: Path) -> tuple[str, str] | None:
    with open_regular(path) as file:
        head = file.read(HEAD_BYTES)
        file.seek(0)
        if (found := stand_in_of(head)) is not None:
            return found
        if head.startswith(b"PK\x03\x04"):
            return _zip(path)
        if head[8:9] == b"{":
            (length,) = struct.unpack("<Q", file.read(8))
            return _safetensors(path, file.read(min(length, MAX_HEADER_BYTES)))
    if path.suffix == ".onnx":
        return "an ONNX model", f"fly it with --policy onnx:{path}"
    return None


def _zip(path: Path) -> tuple[str, str] | None:
    try:
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
            if any("/code/" in name or name.endswith("/constants.pkl") for name in names):
                return "a TorchScript archive", f"fly it with --policy torchscript:{path}"
            for sign, what in _ARCHIVES.items():
                if any(name.rpartition("/")[2] == sign for name in names):
                    return what, "write ONNX by torch.onnx.export, and fly --policy onnx:FILE"
            is_torch = any(name.endswith("data.pkl") for name in names)
            return None if is_torch else ("a zip archive", "unpack it, and name what is in it")
    except (zipfile.BadZipFile, ValueError):
        return "cut short, or damaged", "copy or download it again, and compare its size"


def _safetensors(path: Path, text: bytes) -> tuple[str, str] | None:
    try:
        header: Any = json.loads(text)
        metadata = header.pop("__metadata__", {}) or {}
        if "contract" in metadata:
            return None
        names = [str(name) for name in header]
    except (ValueError, TypeError, AttributeError, RecursionError):
        return None  # its reader reports the fault
    if (beside := _lerobot(path.parent)) is not None:
        what, advice = beside
        return f"the weights of {what}", advice
    theirs = ("diffusion.unet.", "model.action_head.")
    if any(name.startswith(theirs) for name in names):
        return (
            "the weights of a LeRobot policy, without the config.json that belongs beside them",
            "name the whole folder: --policy lerobot:DIR",
        )
    return None


def _folder(path: Path) -> tuple[str, str]:
    if (kind := _lerobot(path)) is not None:
        return kind
    for sign, what, advice in _FOLDERS:
        if any(path.glob(sign)):
            return what, advice.format(path, sign.rstrip("/"))
    there = sorted(each.name for each in path.iterdir())[:8]
    return "a folder", f"name a file; it holds {there}"


def _lerobot(folder: Path) -> tuple[str, str] | None:
    """Return the LeRobot policy in a folder and the next step; None if there is none."""
    try:
        config: Any = read_json(folder / "config.json")
    except (OSError, ValueError):
        return None
    if not isinstance(config, dict) or "type" not in config:
        return None
    kind = config["type"]
    if kind in LEROBOT_TYPES:
        return f"a LeRobot policy ({kind})", f"fly its folder with --policy lerobot:{folder}"
    if "input_features" not in config:
        return None
    return (
        f"a LeRobot policy of type {kind!r}",
        f"of its types {' and '.join(LEROBOT_TYPES)} fly from their files; run this one in "
        "LeRobot's own environment behind --policy ws://HOST:PORT",
    )


def require_file(path: Path, suffixes: Sequence[str]) -> None:
    """Raise CheckpointError, naming what was found, if a path is not a file with such a suffix."""
    if (sentence := detect(path)) is not None:
        raise CheckpointError(sentence)
    if path.suffix not in suffixes:
        raise CheckpointError(f"{path}: not a checkpoint; use one of {', '.join(suffixes)}")
    if not path.is_file():
        near = sorted(p.name for p in path.parent.glob("*") if p.suffix in suffixes)
        there = f"its folder holds {near}" if near else "its folder holds no checkpoint"
        what = "not a file but a pipe or a device" if path.exists() else "no such file"
        raise CheckpointError(f"{path}: {what}; {there}")


def require_header(path: Path, header: dict[str, str]) -> None:
    """Raise CheckpointError if a file's header does not identify its content."""
    for key in HEADER_KEYS:
        if key not in header:
            raise CheckpointError(
                f"{path}: no {key!r} in the header (it holds {sorted(header)}), so it was not "
                "written by this project; load the weights as .pt and save them with "
                "policy.checkpoints.networks.save_checkpoint"
            )


def read_contract(path: Path) -> Contract | None:
    """Return the contract in a policy's file; None for a ``.pt``, which only torch can read."""
    require_file(path, SUFFIXES)
    if path.suffix != ".safetensors":
        return None
    with open_safetensors(path, "numpy") as file:
        header: dict[str, str] = file.metadata() or {}
    require_header(path, header)
    try:
        return Contract.from_json(header[CONTRACT_KEY])
    except ContractError as error:
        raise CheckpointError(f"{path}: {error}") from error
