"""Weights small enough to ship: int8 for the encoder's convolutions, half precision for the rest.

An encoder holds most of a policy's weights and is the least sensitive to them: each output channel
of a convolution has a scale of its own, so a weight is off by at most 1/254 of its channel's
largest. What has one dimension (norms, biases) stays in float32.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

SCALE = ".int8_scale"
"""After a weight's name: its scales, one an output channel."""
_LARGEST = 127.0


def pack(state: Mapping[str, Tensor], *, coarse: str) -> dict[str, Tensor]:
    """Weights for a file, from float32 weights; those whose names begin with ``coarse`` in int8."""
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
