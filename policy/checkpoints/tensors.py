"""Files of weights, whatever the network: read, written, and refused by a ``CheckpointError``."""

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn

from policy.checkpoints.header import open_safetensors
from policy.errors import CheckpointError


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write a ``.safetensors`` file; replaces ``path`` at once or not at all."""
    if path.suffix != ".safetensors":
        raise CheckpointError(f"{path}: checkpoints are written as .safetensors; rename it")
    partial = path.with_name(path.name + ".partial")
    try:
        save_file(dict(tensors), partial, metadata=dict(header))
        partial.replace(path)
    except (OSError, SafetensorError) as error:
        partial.unlink(missing_ok=True)
        raise CheckpointError(f"cannot write {path}: {error}") from error


def read_tensors(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Header and tensors of a ``.safetensors`` file."""
    with open_safetensors(path, "pt") as file:
        header = file.metadata() or {}
        return header, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict


def require_finite(path: Path, state: Mapping[str, Tensor]) -> None:
    """Refuse weights with NaN or infinity among them."""
    bad = [name for name, value in state.items() if not torch.isfinite(value).all()]
    if bad:
        raise CheckpointError(
            f"{path}: {len(bad)} tensors hold NaN or infinity, the first is {bad[0]!r}: "
            "training diverged; take an earlier checkpoint"
        )


def require_fit(path: Path, policy: nn.Module, state: Mapping[str, Tensor]) -> None:
    """Name the first few weights that do not fit; torch's own message lists hundreds."""
    wanted = {name: list(value.shape) for name, value in policy.state_dict().items()}
    problems = [f"missing {name!r}" for name in wanted if name not in state]
    problems += [f"unexpected {name!r}" for name in state if name not in wanted]
    problems += [
        f"{name!r} is {list(state[name].shape)}, must be {shape}"
        for name, shape in wanted.items()
        if name in state and list(state[name].shape) != shape
    ]
    if problems:
        raise CheckpointError(
            f"{path}: does not fit this policy in {len(problems)} places: "
            f"{'; '.join(problems[:4])}. Choose the size and backbone that it was trained with"
        )
