"""AdamW, a moving average of the weights, and the number format."""

import copy
from typing import Generic, TypeVar

import torch
from torch import nn

from policy.training.settings import Precision

M = TypeVar("M", bound=nn.Module)


class Ema(Generic[M]):
    """An exponential moving average of a module's weights, itself such a module in eval mode."""

    def __init__(self, trainee: M, decay: float) -> None:
        self.average = copy.deepcopy(trainee).eval().requires_grad_(False)
        self._decay = decay

    @torch.no_grad()
    def update(self, trainee: M, updates: int) -> None:
        """Move towards ``trainee``, faster in the first of ``updates``; counters are copied.

        Frozen weights are the same in both, and are left alone.
        """
        weight = 1.0 - min(self._decay, (1 + updates) / (10 + updates))
        frozen = {name for name, one in trainee.named_parameters() if not one.requires_grad}
        new = {name: one for name, one in trainee.state_dict().items() if name not in frozen}
        old = self.average.state_dict()
        names = [name for name, value in new.items() if value.is_floating_point()]
        torch._foreach_lerp_(  # one call for some thousand tensors
            [old[name] for name in names], [new[name] for name in names], weight
        )
        for name in new.keys() - set(names):
            old[name].copy_(new[name])


def make_optimiser(trainee: nn.Module, learning_rate: float, decay: float) -> torch.optim.AdamW:
    """AdamW over the trainable weights; biases, norms and other vectors are not decayed."""
    trainable = [p for p in trainee.parameters() if p.requires_grad]
    groups = [
        {"params": [p for p in trainable if p.ndim >= 2], "weight_decay": decay},
        {"params": [p for p in trainable if p.ndim < 2], "weight_decay": 0.0},
    ]
    return torch.optim.AdamW(groups, lr=learning_rate, betas=(0.9, 0.98), fused=True)


def uses_bf16(precision: Precision, device: torch.device) -> bool:
    """Whether to compute in bfloat16; ``auto`` does so where the hardware multiplies it."""
    if precision != "auto":
        return precision == "bf16"
    if device.type == "cuda":
        return bool(torch.cuda.is_bf16_supported())
    return device.type == "cpu" and bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
