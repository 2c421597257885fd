"""Files of weights, whatever the network: read, written, and refused by a ``CheckpointError``."""

from collections.abc import Mapping
from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn

from policy.checkpoints.state_dicts import Shapes, misfits
from policy.errors import CheckpointError
from policy.files import open_safetensors, whole_file

SCALE = ".int8_scale"
"""After a weight's name: its scales, one an output channel."""
_LARGEST = 127.0


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write a ``.safetensors`` file; replaces ``path`` at once or not at all."""
    if path.suffix != ".safetensors":
        raise CheckpointError(f"{path}: checkpoints are written as .safetensors; rename it")
    try:
        with whole_file(path) as draft:
            save_file(dict(tensors), draft, metadata=dict(header))
    except (OSError, SafetensorError) as error:
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


def shapes_of(network: nn.Module) -> Shapes:
    """Shape of each weight of a network."""
    return {name: tuple(value.shape) for name, value in network.state_dict().items()}


def require_fit(path: Path, policy: nn.Module, state: Mapping[str, Tensor], advice: str) -> None:
    """Name the first weights that do not fit, and what to do; torch's message lists hundreds."""
    if problems := misfits(state, shapes_of(policy)):
        raise CheckpointError(
            f"{path}: does not fit this policy in {len(problems)} places: "
            f"{'; '.join(problems[:4])}. {advice}"
        )


def pack(state: Mapping[str, Tensor], *, coarse: str) -> dict[str, Tensor]:
    """Weights small enough to ship, from float32: half precision, but int8 for ``coarse`` prefixes.

    Those are the encoder's: most of the weights, and the least sensitive. Each output channel has a
    scale of its own, so a weight is off by at most 1/254 of its channel's largest. What has one
    dimension (norms, biases) stays in float32.
    """
    packed: dict[str, Tensor] = {}
    for name, value in state.items():
        if value.ndim < 2 or value.dtype != torch.float32:
            packed[name] = value
        elif name.startswith(coarse):
            scale = value.flatten(1).abs().amax(dim=1).clamp_min(torch.finfo().tiny) / _LARGEST
            per_channel = scale.view(-1, *[1] * (value.ndim - 1))
            packed[name] = (value / per_channel).round().to(torch.int8)
            packed[name + SCALE] = scale
        else:
            packed[name] = value.to(torch.float16)
    return packed


def unpack(packed: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Weights of a file as float32; those that are not packed come back as they are."""
    state: dict[str, Tensor] = {}
    for name, value in packed.items():
        scale = packed.get(name + SCALE)
        if scale is not None:
            state[name] = value.float() * scale.view(-1, *[1] * (value.ndim - 1))
        elif not name.endswith(SCALE):
            state[name] = value.float() if value.dtype == torch.float16 else value
    return state
