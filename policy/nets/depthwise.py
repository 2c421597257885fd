"""Depthwise convolution whose gradients a CPU computes by vectorised kernels.

oneDNN 3.12 has none for the weights of a kernel wider than 3 and, in bfloat16, for the input under
a stride. Its plain loops took half of a training step of EfficientNet-B3.
"""

from typing import Any

import torch
import torch.nn.functional as F
import torch.nn.grad as untyped
from torch import Tensor, nn

gradients_of: Any = untyped
"""The gradients of a convolution, by torch."""


class Depthwise(nn.Conv2d):
    """Convolution of each channel alone, of an odd kernel; [B, C, H, W] -> [B, C, H/s, W/s]."""

    def __init__(self, channels: int, kernel: int, *, stride: int = 1, bias: bool = False) -> None:
        super().__init__(
            channels, channels, kernel, stride, kernel // 2, groups=channels, bias=bias
        )

    def forward(self, x: Tensor) -> Tensor:
        """Filter ``x``."""
        if x.device.type != "cpu" or not self.training:
            return super().forward(x)
        is_cast = torch.is_autocast_enabled("cpu")
        dtype = torch.get_autocast_dtype("cpu") if is_cast else x.dtype
        bias = None if self.bias is None else self.bias.to(dtype)
        filtered: Any = _Filter.apply
        out: Tensor = filtered(x.to(dtype), self.weight.to(dtype), bias, self.stride[0])
        return out


class _Filter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor | None, stride: int) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.stride = stride
        return F.conv2d(x, weight, bias, stride, weight.shape[2] // 2, groups=len(weight))

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, Tensor | None, None]:
        (gradient,), (x, weight), stride = gradients, ctx.saved_tensors, ctx.stride
        for_bias = gradient.sum(dim=(0, 2, 3)) if ctx.needs_input_grad[2] else None
        for_weight = _weight_gradient(x, gradient, weight.shape[2], stride)
        if stride > 1 and x.dtype == torch.bfloat16:  # it keeps some of the outputs of stride 1
            every = torch.zeros_like(x)
            every[:, :, ::stride, ::stride] = gradient
            gradient, stride = every, 1
        shape, padding, channels = list(x.shape), weight.shape[2] // 2, len(weight)
        for_x = gradients_of.conv2d_input(shape, weight, gradient, stride, padding, groups=channels)
        return for_x, for_weight, for_bias, None


def _weight_gradient(x: Tensor, gradient: Tensor, kernel: int, stride: int) -> Tensor:
    """Return the gradient [C, 1, kernel, kernel], in overlapping blocks of 3x3."""
    channels, height, width = x.shape[1:]
    block, margin = [channels, 1, 3, 3], kernel // 2
    if kernel == 3:
        whole: Tensor = gradients_of.conv2d_weight(x, block, gradient, stride, 1, groups=channels)
        return whole
    tall, wide = ((size - 1) * stride + 3 for size in gradient.shape[2:])
    made = x.new_empty(channels, 1, kernel, kernel)
    for row in range(0, kernel - 2, 2):
        above = margin - row
        for column in range(0, kernel - 2, 2):
            left = margin - column
            seen = F.pad(x, (left, wide - left - width, above, tall - above - height))
            part = gradients_of.conv2d_weight(seen, block, gradient, stride=stride, groups=channels)
            made[:, :, row : row + 3, column : column + 3] = part
    return made
