"""Image encoders: ResNets (He et al. 2016) with torchvision's parameter names, and ResNet-8.

ResNet-50 strides in the 3x3 convolution ("v1.5"), as torchvision's weights do.
"""

import math
from functools import lru_cache
from itertools import pairwise

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import FloatArray
from policy.nets.names import BackboneName

MOMENTS = 3
"""Moments per channel: average, and averages weighted by the position rightwards and downwards."""
RESNET8_CHANNELS = (24, 48, 96, 128)
"""Channels out of the first convolution and of the three blocks."""
RESNET8_CELLS = 6
"""Cells along a side of the map before the last layer, for an image of 96 pixels."""
RESNET8_CELL_CHANNELS = 32


def moments(features: Tensor) -> Tensor:
    """Pool a map [B, C, H, W] to [B, 3, C], a vector that keeps the position of objects.

    The usual average tells what is in the image but not where; steering needs both. Diffusion
    policies therefore pool by spatial softmax (Chi et al. 2023). First moments do the same without
    parameters, at any image size, beside the average that ImageNet's weights were trained with.
    """
    height, width = (int(size) for size in features.shape[2:])  # plain numbers also in a trace
    if features.is_cuda:
        weights = _weights_on_gpu(features.device, features.dtype, height, width)
    else:
        weights = torch.from_numpy(moment_weights(height, width)).to(features)
    return torch.matmul(features.flatten(2), weights).transpose(1, 2)


@lru_cache(maxsize=64)
def _weights_on_gpu(device: torch.device, dtype: torch.dtype, height: int, width: int) -> Tensor:
    """Return ``moment_weights``, kept on the GPU: a CUDA graph capture allows no copies."""
    with torch.inference_mode(False):
        return torch.from_numpy(moment_weights(height, width)).to(device, dtype)


def moment_weights(height: int, width: int) -> FloatArray:
    """Return each cell's weights [H * W, 3]; positions have mean 0 and variance of about 1."""
    across = np.broadcast_to(_places(width), (height, width))
    down = np.broadcast_to(_places(height)[:, None], (height, width))
    weights = np.stack([np.ones_like(across), across, down], axis=-1).reshape(-1, MOMENTS)
    return (weights / (height * width)).astype(np.float32)


def _places(count: int) -> FloatArray:
    """Return the centres of ``count`` cells between borders at -sqrt(3) and sqrt(3)."""
    centres = (np.arange(count, dtype=np.float32) + 0.5) * (2.0 / count) - 1.0
    return (math.sqrt(3.0) * centres).astype(np.float32)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions around a shortcut."""

    expansion = 1

    def __init__(self, channels_in: int, width: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, width, 3, stride=stride, padding=1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample = _shortcut(channels_in, width, stride)
        self.relu = nn.ReLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C_in, H, W] -> [B, width, H/stride, W/stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        hidden = self.relu(self.bn1(self.conv1(x)))
        out: Tensor = self.relu(self.bn2(self.conv2(hidden)) + shortcut)
        return out


class Bottleneck(nn.Module):
    """1x1, 3x3, 1x1 convolutions around a shortcut."""

    expansion = 4

    def __init__(self, channels_in: int, width: int, stride: int) -> None:
        super().__init__()
        channels_out = width * self.expansion
        self.conv1 = nn.Conv2d(channels_in, width, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride=stride, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, channels_out, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(channels_out)
        self.downsample = _shortcut(channels_in, channels_out, stride)
        self.relu = nn.ReLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C_in, H, W] -> [B, 4 * width, H/stride, W/stride]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        hidden = self.relu(self.bn1(self.conv1(x)))
        hidden = self.relu(self.bn2(self.conv2(hidden)))
        out: Tensor = self.relu(self.bn3(self.conv3(hidden)) + shortcut)
        return out


_DEPTHS: dict[str, tuple[type[BasicBlock] | type[Bottleneck], tuple[int, int, int, int]]] = {
    "resnet18": (BasicBlock, (2, 2, 2, 2)),
    "resnet34": (BasicBlock, (3, 4, 6, 3)),
    "resnet50": (Bottleneck, (3, 4, 6, 3)),
    "resnet101": (Bottleneck, (3, 4, 23, 3)),
    "resnet152": (Bottleneck, (3, 8, 36, 3)),
}
"""Type and number of the blocks of each layer."""


class LastMap(nn.Module):
    """Image [B, 3, H, W] -> last map [B, channels, ceil(H / 32), ceil(W / 32)] of a ResNet."""

    def __init__(self, name: str) -> None:
        super().__init__()
        block, depths = _DEPTHS[name]
        wide = block.expansion
        self.conv1 = nn.Conv2d(3, 64, 7, stride=2, padding=3, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.relu = nn.ReLU(inplace=True)
        self.maxpool = nn.MaxPool2d(3, stride=2, padding=1)
        self.layer1 = _layer(block, 64, 64, depths[0], stride=1)
        self.layer2 = _layer(block, 64 * wide, 128, depths[1], stride=2)
        self.layer3 = _layer(block, 128 * wide, 256, depths[2], stride=2)
        self.layer4 = _layer(block, 256 * wide, 512, depths[3], stride=2)
        self.channels = 512 * wide

    def forward(self, image: Tensor) -> Tensor:
        """Return the last map."""
        x = self.maxpool(self.relu(self.bn1(self.conv1(image))))
        out: Tensor = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        return out


class ResNet(LastMap):
    """Image [B, 3, H, W] -> moments [B, out_dim]; without torchvision's ``fc``."""

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.out_dim = MOMENTS * self.channels

    def forward(self, image: Tensor) -> Tensor:
        """Return ``moments`` of the last map, flattened."""
        return moments(super().forward(image)).flatten(1)


class ResNet8(nn.Module):
    """Image [B, 3, H, W] -> feature [B, 256], similar to DroNet (Loquercio et al. 2018).

    Three residual blocks, and a layer that sees every cell of the last map. Small enough to learn
    the positions of gates from scratch in about ten minutes on one core.
    """

    out_dim = 256

    def __init__(self) -> None:
        super().__init__()
        first, last = RESNET8_CHANNELS[0], RESNET8_CHANNELS[-1]
        self.conv1 = nn.Conv2d(3, first, 5, stride=2, padding=2, bias=False)
        self.bn1 = nn.BatchNorm2d(first)
        self.relu = nn.ReLU(inplace=True)
        self.layers = nn.Sequential(
            *(BasicBlock(into, out, 2) for into, out in pairwise(RESNET8_CHANNELS))
        )
        self.conv2 = nn.Conv2d(last, RESNET8_CELL_CHANNELS, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(RESNET8_CELL_CHANNELS)
        self.fc = nn.Linear(RESNET8_CELL_CHANNELS * RESNET8_CELLS**2, self.out_dim)

    def forward(self, image: Tensor) -> Tensor:
        """Apply a fully connected layer to the cells of the last map."""
        x = self.layers(self.relu(self.bn1(self.conv1(image))))
        x = self.relu(self.bn2(self.conv2(x)))
        is_uneven = any(int(side) % RESNET8_CELLS for side in x.shape[2:])
        if is_uneven and torch.onnx.is_in_onnx_export():
            cells = _pooled(_pooled(x, 2), 3)
        else:
            cells = F.adaptive_avg_pool2d(x, RESNET8_CELLS)
        feature: Tensor = self.relu(self.fc(cells.flatten(1)))
        return feature


def _pooled(x: Tensor, axis: int) -> Tensor:
    """Pool an axis as ``adaptive_avg_pool2d`` does, which ONNX has for multiples of the cells."""
    size, cells = int(x.shape[axis]), range(RESNET8_CELLS)
    spans = [(k * size // RESNET8_CELLS, -(-(k + 1) * size // RESNET8_CELLS)) for k in cells]
    parts = [x.narrow(axis, start, end - start).mean(axis) for start, end in spans]
    return torch.stack(parts, axis)


def build_backbone(name: BackboneName) -> ResNet | ResNet8:
    """Build an encoder with random weights: normalised image [B, 3, H, W] -> feature [B, out_dim].

    He et al. 2015, fan-in: the signal survives the depth before any batch norm has statistics. With
    torch's own default a deep encoder maps every image to almost nothing.
    """
    backbone = ResNet8() if name == "resnet8" else ResNet(name)
    for module in backbone.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_in", nonlinearity="relu")
    return backbone


def _layer(
    block: type[BasicBlock] | type[Bottleneck],
    channels_in: int,
    width: int,
    depth: int,
    *,
    stride: int,
) -> nn.Sequential:
    first = block(channels_in, width, stride)
    rest = [block(width * block.expansion, width, 1) for _ in range(depth - 1)]
    return nn.Sequential(first, *rest)


def _shortcut(channels_in: int, channels_out: int, stride: int) -> nn.Sequential | None:
    if stride == 1 and channels_in == channels_out:
        return None
    return nn.Sequential(
        nn.Conv2d(channels_in, channels_out, 1, stride=stride, bias=False),
        nn.BatchNorm2d(channels_out),
    )
