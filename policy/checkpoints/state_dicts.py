"""Weights of a network in what ``torch.load`` returned, with or without a trainer's wrapping."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
    def is_averaged(self) -> bool:
        """An average of weights, by its name."""
        return _AVERAGED.search(self.where) is not None

    @property
    def note(self) -> str | None:
        """A line for a person where there was a choice, or a prefix."""
        if self.is_averaged:
            besides = f", not those under {self.left!r}" if self.left else ""
            return f"the averaged weights under {self.where!r} fly{besides}"
        return None if self.where in ("", *USUAL_KEYS[:2]) else f"weights under {self.where!r}"


def find_weights(path: Path, loaded: Mapping[Any, Any], wanted: Shapes) -> FoundWeights:
    """Return the weights in a file that fit a network, or else those that come nearest.

    They may lie under keys (``state_dict``, ``ema``) and behind prefixes (``module.``, ``net.``).
    Averaged weights are preferred to those that they are the average of.
    """
    found = [
        FoundWeights(state=state, where=f"{key}.{prefix}".strip("."))
        for key, table in _tables(loaded)
        for prefix, state in _behind_prefixes(table, wanted)
    ]
    if not found or "param_groups" in loaded:
        raise CheckpointError(
            f"{path}: no weights found; it must hold 'model_state_dict' or 'state_dict', or be a "
            f"state dict itself, and holds {sorted(map(str, loaded))[:8]}"
        )
    fitting = [each for each in found if not misfits(each.state, wanted)]
    if not fitting:
        return min(found, key=lambda each: len(misfits(each.state, wanted)))
    averaged = [each for each in fitting if each.is_averaged]
    plain = [each for each in fitting if not each.is_averaged]
    if averaged and plain:
        return replace(averaged[0], left=plain[0].where)
    return (averaged or plain)[0]


def misfits(state: Mapping[str, Tensor], wanted: Shapes) -> list[str]:
    """Return a phrase for each weight that keeps a state dict from being loaded."""
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
        yield (
            prefix,
            {n.removeprefix(prefix): value for n, value in table.items() if n.startswith(prefix)},
        )
