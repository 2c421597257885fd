"""The weights of a network in what ``torch.load`` returned, whatever a trainer put around them."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from policy.errors import CheckpointError

USUAL_KEYS = ("model_state_dict", "state_dict", "model", "policy", "net")
ANCHORS = 8
"""Names of weights that are looked for behind a prefix, from all parts of the network."""
_AVERAGED = re.compile(r"(^|[._])(ema|averaged|average|swa|shadow)([._]|$)")
Shapes = Mapping[str, tuple[int, ...]]
"""Shape of each weight by its name."""


@dataclass(frozen=True, kw_only=True)
class FoundWeights:
    """A state dict with the names of the network, and where it was found."""

    state: dict[str, Tensor]
    where: str = ""
    """Keys and prefix that were taken away; empty where the file is a state dict."""
    left: str = ""
    """Where other weights were that fit as well; averaged ones are taken in place of these."""

    @property
    def note(self) -> str | None:
        """A line for a person where there was a choice, or a prefix."""
        if self.left:
            return f"the averaged weights under {self.where!r} fly, not those under {self.left!r}"
        if _AVERAGED.search(self.where):
            return f"the averaged weights under {self.where!r} fly"
        return None if self.where in ("", *USUAL_KEYS[:2]) else f"weights under {self.where!r}"


def find_weights(path: Path, loaded: Mapping[Any, Any], wanted: Shapes) -> FoundWeights:
    """The weights in a file that fit a network, or else those that come nearest.

    They may lie under keys (``state_dict``, ``ema``) and behind prefixes (``module.``, ``net.``).
    Averaged weights are preferred to those that they are the average of.
    """
    tables = {} if "param_groups" in loaded else dict(_tables(loaded))
    if not tables:
        raise CheckpointError(f"{path}: {_why_none(loaded)}")
    found = [
        FoundWeights(state=state, where=f"{key}.{prefix}".strip(".") if key or prefix else "")
        for key, table in tables.items()
        for prefix, state in _behind_prefixes(table, wanted)
    ]
    fitting = [each for each in found if not misfits(each.state, wanted)]
    if fitting:
        averaged = [each for each in fitting if _AVERAGED.search(each.where)]
        plain = [each for each in fitting if not _AVERAGED.search(each.where)]
        best = (averaged or plain)[0]
        left = plain[0].where if averaged and plain else ""
        return FoundWeights(state=best.state, where=best.where, left=left)
    nearest = min(found, key=lambda each: len(misfits(each.state, wanted)))
    _require_not_quantised(path, nearest.state)
    return nearest


def misfits(state: Mapping[str, Tensor], wanted: Shapes) -> list[str]:
    """What keeps a state dict from being loaded, a phrase for each weight."""
    problems = [f"missing {name!r}" for name in wanted if name not in state]
    problems += [f"unexpected {name!r}" for name in state if name not in wanted]
    problems += [
        f"{name!r} is {list(state[name].shape)}, must be {list(shape)}"
        for name, shape in wanted.items()
        if name in state and tuple(state[name].shape) != shape
    ]
    return problems


def _tables(loaded: Mapping[Any, Any]) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """Every dictionary of tensors by name, with its key; the usual keys first, two levels deep."""
    first = [key for key in USUAL_KEYS if key in loaded]
    for key in (*first, *(key for key in loaded if key not in first)):
        value = loaded[key]
        if not isinstance(value, Mapping) or key in ("optimizer", "optimizer_state_dict"):
            continue
        if table := _tensors(value):
            yield str(key), table
        for inner, below in value.items():
            if isinstance(below, Mapping) and (table := _tensors(below)):
                yield f"{key}.{inner}", table
    if table := _tensors(loaded):
        yield "", table


def _tensors(value: Mapping[Any, Any]) -> dict[str, Tensor]:
    return {
        name: each
        for name, each in value.items()
        if isinstance(name, str) and isinstance(each, Tensor)
    }


def _behind_prefixes(
    table: dict[str, Tensor], wanted: Shapes
) -> Iterator[tuple[str, dict[str, Tensor]]]:
    """The table as it is, and what is left of it behind each prefix of a wanted name."""
    yield "", table
    anchors = list(wanted)[:: max(1, len(wanted) // ANCHORS)]
    prefixes = {
        name.removesuffix(anchor): None
        for name in table
        for anchor in anchors
        if name.endswith("." + anchor)
    }
    for prefix in prefixes:
        behind = {
            name.removeprefix(prefix): value
            for name, value in table.items()
            if name.startswith(prefix)
        }
        yield prefix, behind


def _require_not_quantised(path: Path, state: Mapping[str, Tensor]) -> None:
    whole = [name for name, value in state.items() if value.ndim >= 2 and _is_coarse(value)]
    if whole or any("_packed_params" in name for name in state):
        raise CheckpointError(
            f"{path} is a quantised network: save the state_dict of the one with floating-point "
            "weights; the engines here round to bf16 by themselves where the machine gains by it"
        )


def _is_coarse(value: Tensor) -> bool:
    return value.is_quantized or value.dtype in (torch.int8, torch.uint8)


def _why_none(loaded: Mapping[Any, Any]) -> str:
    """What a file without a state dict is, and what to do."""
    if "param_groups" in loaded or any(str(key).startswith("optimizer") for key in loaded):
        return "holds the state of an optimiser, without weights: name the file of the weights"
    if isinstance(loaded.get("shadow_params"), list):
        return (
            "holds averaged weights without their names (shadow_params): copy them into the "
            "network, and save its state_dict()"
        )
    return (
        "no weights found; it must hold 'model_state_dict' or 'state_dict', or be a state "
        f"dict itself, and holds {sorted(map(str, loaded))[:8]}"
    )
