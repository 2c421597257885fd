"""The header of a checkpoint, read without torch and without the weights.

What is wrong with a file is raised as a ``CheckpointError``.
"""

from collections.abc import Sequence
from pathlib import Path

from policy.checkpoints.detect import detect
from policy.contract import Contract
from policy.errors import CheckpointError
from policy.files import open_safetensors

CONTRACT_KEY = "contract"
ARCHITECTURE_KEY = "architecture"
TRAINING_KEY = "training"
HEADER_KEYS = (CONTRACT_KEY, ARCHITECTURE_KEY)
SUFFIXES = (".safetensors", ".pt", ".pth", ".ckpt")


def require_file(path: Path, suffixes: Sequence[str]) -> None:
    """Refuse a path that is not a file of one of these suffixes, and say what is there."""
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
    """Refuse a file that does not say what it is."""
    for key in HEADER_KEYS:
        if key not in header:
            raise CheckpointError(
                f"{path}: no {key!r} in the header (it holds {sorted(header)}), so it was not "
                "written by this project; load the weights as .pt and save them with "
                "policy.checkpoints.policy_file.save_checkpoint"
            )


def read_contract(path: Path) -> Contract | None:
    """The contract in a policy's file; None where it is a ``.pt``, which only torch can read."""
    require_file(path, SUFFIXES)
    if path.suffix != ".safetensors":
        return None
    with open_safetensors(path, "numpy") as file:
        header: dict[str, str] = file.metadata() or {}
    require_header(path, header)
    return Contract.from_json(header[CONTRACT_KEY])
