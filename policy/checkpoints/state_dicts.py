"""Search for a network's weights in the result of ``torch.load``, bare or wrapped."""

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from torch import Tensor

from policy.errors import CheckpointError

USUAL_KEYS = ("model_state_dict", "state_dict", "model", "policy", "net")
ANCHORS = 8
"""Number of weight names, from all parts of the network, to search for behind a prefix."""
_AVERAGED = re.compile(r"(^|[._])(ema|averaged|average|swa|shadow)([._]|$)")
Shapes = Mapping[str, tuple[int, ...]]
"""Shape of each weight by name."""


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
