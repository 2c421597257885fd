"""Reading, writing and checking of weight files of any network; faults are ``CheckpointError``."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor, nn
from torch.nn.modules.utils import consume_prefix_in_state_dict_if_present
from torch.overrides import TorchFunctionMode

from policy.errors import CheckpointError, PolicyError
from policy.files import open_safetensors, whole_file

SCALE = ".int8_scale"
"""Suffix of a weight's name for its scales, one per output channel."""
_LARGEST = 127.0
USUAL_KEYS = ("state_dict", "model_state_dict")
"""Keys of the weights in a file of ``torch.save``."""
_COUNT = "num_batches_tracked"
"""End of the name of an integer."""
_REAL = (torch.float16, torch.bfloat16, torch.float32, torch.float64)
_UNBUILDABLE = (PolicyError, ArithmeticError, LookupError, TypeError, ValueError, RuntimeError)
"""Exceptions of networks for sizes that nothing has."""
_SPARE = 10_000_000
"""Numbers that a network may have besides those of its file."""
_LEAST = 1000
"""Cost of a small tensor in numbers."""
Net = TypeVar("Net", bound=nn.Module)


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


class _Budget(TorchFunctionMode):
    """Raises PolicyError where a network asks for more numbers than its file has.

    A header of a few bytes may ask for any size, and for any number of layers. Building it on the
    meta device first would tell as well, but takes 2 s: torch imports its compiler for that.
    """

    def __init__(self, state: Mapping[str, Tensor], advice: str) -> None:
        super().__init__()
        self._advice = advice
        self._file_has = sum(value.numel() for value in state.values())
        self._left = _SPARE + 2 * self._file_has + 2 * _LEAST * len(state)

    def __torch_function__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: Any = None
    ) -> Any:
        if func in (torch.empty, torch.ones, torch.randn, torch.zeros):
            sizes = args[0] if args and isinstance(args[0], Sequence) else args
            self._left -= max(_LEAST, math.prod(sizes))
            if self._left < 0:
                raise PolicyError(
                    f"its {self._file_has} numbers are far too few for this network. {self._advice}"
                )
        return func(*args, **(kwargs or {}))


def load_fitting(
    path: Path, build: Callable[[], Net], state: Mapping[str, Tensor], advice: str
) -> Net:
    """Build a network, load its weights, return it in eval mode; batch counts may be missing."""
    try:
        with _Budget(state, advice):
            net = build()
    except _UNBUILDABLE as error:
        raise CheckpointError(f"{path}: {error}") from error
    _require_fit(path, net.state_dict(), state, advice)
    net.load_state_dict(state, strict=False)
    require_finite(path, net.state_dict())
    return net.eval()


def _require_fit(
    path: Path, wanted: Mapping[str, Tensor], state: Mapping[str, Tensor], advice: str
) -> None:
    """Raise CheckpointError with the first misfits and the next step; torch would list hundreds."""
    missing = [name for name in wanted if name not in state and not name.endswith(_COUNT)]
    unexpected = [name for name in state if name not in wanted]
    misfits = []
    for name, value in state.items():
        if name not in wanted:
            continue
        if (shape := list(wanted[name].shape)) != list(value.shape):
            misfits.append(f"{name!r} is {list(value.shape)}, must be {shape}")
        is_plain = value.layout == torch.strided and not value.is_meta
        if not is_plain or (value.dtype not in _REAL and not name.endswith(_COUNT)):
            misfits.append(f"{name!r} is no dense tensor of real numbers, but {value.dtype}")
    if count := len(missing) + len(unexpected) + len(misfits):
        shown = [f"missing {name!r}" for name in missing[:2]]
        shown += [f"unexpected {name!r}" for name in unexpected[:2]]
        if wrapped := [name for name in unexpected if missing and name.endswith(f".{missing[0]}")]:
            prefix = wrapped[0].removesuffix(missing[0])
            advice = f"Its names begin with {prefix!r}: save the network's own state_dict()"
        raise CheckpointError(
            f"{path}: does not fit this policy in {count} places: "
            f"{'; '.join([*shown, *misfits][:4])}. {advice}"
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
    """Return a file's weights with int8 as float32; what is not packed so stays unchanged."""
    state = dict(packed)
    for name, value in packed.items():
        scale = packed.get(name + SCALE)
        if scale is None or (value.dtype, scale.dtype) != (torch.int8, torch.float32):
            continue
        if scale.shape == value.shape[:1]:
            state[name] = value * scale.view(-1, *[1] * (value.ndim - 1))
            del state[name + SCALE]
    return state


def find_weights(path: Path, loaded: Mapping[Any, Any]) -> dict[str, Tensor]:
    """Return the weights of a torch file: it is a state dict, or holds one under a usual key."""
    counts = {
        key: sum(
            each.numel()
            for each in table.values()
            if isinstance(each, Tensor) and each.is_floating_point()
        )
        for key, table in loaded.items()
        if isinstance(table, Mapping)
    }
    # Metrics and statistics are far smaller; averages may leave out a frozen encoder.
    tables = [key for key, count in counts.items() if count and 20 * count >= max(counts.values())]
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
        # Of data-parallel and compiled networks, in either order.
        for prefix in ("module.", "_orig_mod.", "module."):
            consume_prefix_in_state_dict_if_present(weights, prefix)
        if weights:
            return weights
    raise CheckpointError(
        f"{path}: no weights found; it holds {sorted(map(str, loaded))[:8]}, and must be a state "
        f"dict, or hold one as {' or '.join(map(repr, USUAL_KEYS))}: save model.state_dict()"
    )
