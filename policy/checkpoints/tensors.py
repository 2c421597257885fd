"""Reading, writing and checking of weight files of any network; faults are ``CheckpointError``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.modules.utils import consume_prefix_in_state_dict_if_present

from policy.errors import CheckpointError
from policy.files import open_safetensors, whole_file

SCALE = ".int8_scale"
"""Suffix of a weight's name for its scales, one per output channel."""
_LARGEST = 127.0
USUAL_KEYS = ("state_dict", "model_state_dict")
"""Keys of the weights in a file of ``torch.save``."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write a ``.safetensors`` file; replaces ``path`` atomically."""
    try:
        with whole_file(path) as draft:
            save_file(dict(tensors), draft, metadata=dict(header))
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"cannot write {path}: {error}") from error


def read_tensors(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Return header and tensors of a ``.safetensors`` file."""
    with open_safetensors(path, "pt") as file:
        header = file.metadata() or {}
        return header, {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a dict


def require_finite(path: Path, state: Mapping[str, Tensor]) -> None:
    """Raise CheckpointError if a weight is NaN or infinite."""
    bad = [name for name, value in state.items() if not torch.isfinite(value).all()]
    if bad:
        raise CheckpointError(
            f"{path}: {len(bad)} tensors hold NaN or infinity, the first is {bad[0]!r}: "
            "training diverged; take an earlier checkpoint"
        )


def require_fit(path: Path, policy: nn.Module, state: Mapping[str, Tensor], advice: str) -> None:
    """Raise CheckpointError with the first misfits and the next step; torch would list hundreds."""
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
            f"{'; '.join(problems[:4])}. {advice}"
        )


def pack(state: Mapping[str, Tensor], *, coarse: str) -> dict[str, Tensor]:
    """Shrink float32 weights for shipping: half precision, and int8 for ``coarse`` prefixes.

    The coarse weights are the encoder's: the most numerous and the least sensitive. Each output
    channel has its own scale, so a weight's error is at most 1/254 of the largest in its channel.
    One-dimensional weights (norms, biases) stay in float32.
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
    """Return a file's weights as float32; weights that are not packed stay unchanged."""
    state: dict[str, Tensor] = {}
    for name, value in packed.items():
        scale = packed.get(name + SCALE)
        if scale is not None:
            state[name] = value.float() * scale.view(-1, *[1] * (value.ndim - 1))
        elif not name.endswith(SCALE):
            state[name] = value.float() if value.dtype == torch.float16 else value
    return state


def find_weights(path: Path, loaded: Mapping[Any, Any]) -> dict[str, Tensor]:
    """Return the weights of a torch file: it is a state dict, or holds one under a usual key."""
    tables = [
        key
        for key, table in loaded.items()
        if isinstance(table, Mapping) and any(isinstance(each, Tensor) for each in table.values())
    ]
    if len(tables) > 1:
        raise CheckpointError(
            f"{path}: holds weights as {' and '.join(map(repr, tables))}: save those that are to "
            "fly alone, as model.state_dict()"
        )
    found = next((loaded[key] for key in USUAL_KEYS if key in loaded), loaded)
    if isinstance(found, Mapping):
        weights = {
            name: value
            for name, value in found.items()
            if isinstance(name, str) and isinstance(value, Tensor)
        }
        # Of data-parallel and compiled networks.
        for prefix in ("module.", "_orig_mod."):
            consume_prefix_in_state_dict_if_present(weights, prefix)
        if weights:
            return weights
    raise CheckpointError(
        f"{path}: no weights found; it holds {sorted(map(str, loaded))[:8]}, and must be a state "
        f"dict, or hold one as {' or '.join(map(repr, USUAL_KEYS))}: save model.state_dict()"
    )
