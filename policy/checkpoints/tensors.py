"""Reading, writing and checking of weight files of any network; faults are ``CheckpointError``.

A file of ``torch.load`` may hold the weights bare or wrapped; ``find_weights`` finds them.
"""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn

from policy.errors import CheckpointError
from policy.files import open_safetensors, whole_file

SCALE = ".int8_scale"
"""Suffix of a weight's name for its scales, one per output channel."""
_LARGEST = 127.0
USUAL_KEYS = ("model_state_dict", "state_dict", "model", "policy", "net")
ANCHORS = 8
"""Number of weight names, from all parts of the network, to search for behind a prefix."""
_AVERAGED = re.compile(r"(^|[._])(ema|averaged|average|swa|shadow)([._]|$)")
Shapes = Mapping[str, tuple[int, ...]]
"""Shape of each weight by name."""


def write_tensors(path: Path, tensors: Mapping[str, Tensor], header: Mapping[str, str]) -> None:
    """Write a ``.safetensors`` file; replaces ``path`` atomically."""
    if path.suffix != ".safetensors":
        raise CheckpointError(f"{path}: checkpoints are written as .safetensors; rename it")
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


def shapes_of(network: nn.Module) -> Shapes:
    """Return the shape of each weight of a network."""
    return {name: tuple(value.shape) for name, value in network.state_dict().items()}


def require_fit(path: Path, policy: nn.Module, state: Mapping[str, Tensor], advice: str) -> None:
    """Raise CheckpointError with the first misfits and the next step; torch would list hundreds."""
    if problems := misfits(state, shapes_of(policy)):
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


def find_weights(
    path: Path, loaded: Mapping[Any, Any], wanted: Shapes
) -> tuple[dict[str, Tensor], str | None]:
    """Return the weights in a file that fit a network, or else the closest candidate.

    They may be under keys (``state_dict``, ``ema``) and behind prefixes (``module.``, ``net.``).
    Averaged weights are preferred to the weights behind the average. The second value is a line for
    the user if there was a choice or a prefix.
    """
    found = [
        (f"{key}.{prefix}".strip("."), state)
        for key, table in _tables(loaded)
        for prefix, state in _behind_prefixes(table, wanted)
    ]
    if not found or "param_groups" in loaded:
        raise CheckpointError(
            f"{path}: no weights found; it must hold 'model_state_dict' or 'state_dict', or be a "
            f"state dict itself, and holds {sorted(map(str, loaded))[:8]}"
        )
    fitting = [each for each in found if not misfits(each[1], wanted)]
    if not fitting:
        return min((state for _, state in found), key=lambda each: len(misfits(each, wanted))), None
    averaged = [each for each in fitting if _AVERAGED.search(each[0])]
    where, state = (averaged or fitting)[0]
    if averaged:
        plain = next((name for name, _ in fitting if not _AVERAGED.search(name)), None)
        besides = f", not those under {plain!r}" if plain is not None else ""
        return state, f"the averaged weights under {where!r} fly{besides}"
    return state, None if where in ("", *USUAL_KEYS[:2]) else f"weights under {where!r}"


def misfits(state: Mapping[str, Tensor], wanted: Shapes) -> list[str]:
    """Return a phrase for each weight that prevents loading a state dict."""
    problems = [f"missing {name!r}" for name in wanted if name not in state]
    problems += [f"unexpected {name!r}" for name in state if name not in wanted]
    problems += [
        f"{name!r} is {list(state[name].shape)}, must be {list(shape)}"
        for name, shape in wanted.items()
        if name in state and tuple(state[name].shape) != shape
    ]
    return problems


def _tables(loaded: Mapping[Any, Any]) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """Yield every dictionary of tensors, up to two levels deep, with its key; usual keys first."""
    first = [key for key in USUAL_KEYS if key in loaded]
    for key in (*first, *(key for key in loaded if key not in first)):
        value = loaded[key]
        if not isinstance(value, Mapping) or key in ("optimizer", "optimizer_state_dict"):
            continue
        for inner, table in (("", value), *value.items()):
            if isinstance(table, Mapping) and (tensors := _tensors(table)):
                yield f"{key}.{inner}".strip("."), tensors
    if tensors := _tensors(loaded):
        yield "", tensors


def _tensors(value: Mapping[Any, Any]) -> dict[str, Tensor]:
    return {
        name: each
        for name, each in value.items()
        if isinstance(name, str) and isinstance(each, Tensor)
    }


def _behind_prefixes(
    table: dict[str, Tensor], wanted: Shapes
) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """Yield the table, and its entries behind each prefix of a wanted name, prefix removed."""
    yield "", table
    anchors = list(wanted)[:: max(1, len(wanted) // ANCHORS)]
    prefixes = {
        name.removesuffix(anchor): None
        for name in table
        for anchor in anchors
        if name.endswith("." + anchor)
    }
    for prefix in prefixes:
        yield (
            prefix,
            {n.removeprefix(prefix): value for n, value in table.items() if n.startswith(prefix)},
        )
