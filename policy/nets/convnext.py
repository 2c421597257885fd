"""ConvNeXt-Tiny (Liu et al. 2022) with torchvision's parameter names.

Stochastic depth is left out: it holds no parameters and does nothing in flight.
"""

import torch
from torch import Tensor, nn

from policy.nets.pooling import MOMENTS, moments

WIDTHS = (96, 192, 384, 768)
DEPTHS = (3, 3, 9, 3)
NORM_EPS = 1e-6


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of [B, C, H, W]."""

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, H, W] -> the same."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Permute(nn.Module):
    """Reorder the axes; a module because its place counts in torchvision's names."""

    def __init__(self, *axes: int) -> None:
        super().__init__()
        self.axes = axes

    def forward(self, x: Tensor) -> Tensor:
        """``x`` with its axes in the new order."""
        return x.permute(self.axes)


class ConvNextBlock(nn.Module):
    """Depthwise 7x7, then a per-position MLP, scaled, around a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.block = nn.Sequential(
            nn.Conv2d(channels, channels, 7, padding=3, groups=channels),
            Permute(0, 2, 3, 1),
            nn.LayerNorm(channels, eps=NORM_EPS),
            nn.Linear(channels, 4 * channels),
            nn.GELU(),
            nn.Linear(4 * channels, channels),
            Permute(0, 3, 1, 2),
        )
        self.layer_scale = nn.Parameter(torch.full((channels, 1, 1), 1e-6))

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, H, W] -> the same."""
        out: Tensor = x + self.layer_scale * self.block(x)
        return out


class ConvNextTiny(nn.Module):
    """Image [B, 3, H, W] -> moments [B, 3 * 768].

    The norm of their average bears torchvision's name ``classifier.0``; the linear layer after it,
    ``classifier.2``, is left out.
    """

    classifier_keys = ("classifier.2.weight", "classifier.2.bias")

    def __init__(self) -> None:
        super().__init__()
        stem = nn.Conv2d(3, WIDTHS[0], 4, stride=4)
        layers: list[nn.Module] = [nn.Sequential(stem, ChannelNorm(WIDTHS[0], eps=NORM_EPS))]
        for index, (width, depth) in enumerate(zip(WIDTHS, DEPTHS, strict=True)):
            layers.append(nn.Sequential(*[ConvNextBlock(width) for _ in range(depth)]))
            if index + 1 < len(WIDTHS):
                halve = nn.Conv2d(width, WIDTHS[index + 1], 2, stride=2)
                layers.append(nn.Sequential(ChannelNorm(width, eps=NORM_EPS), halve))
        self.features = nn.Sequential(*layers)
        self.classifier = nn.Sequential(ChannelNorm(WIDTHS[-1], eps=NORM_EPS), nn.Flatten())
        self.out_dim = MOMENTS * WIDTHS[-1]

    def forward(self, image: Tensor) -> Tensor:
        """``pooling.moments`` of the last map, flat, the average normalised."""
        features = self.features(image)
        average = self.classifier(features.mean(dim=(2, 3), keepdim=True))
        return torch.cat([average, moments(features)[:, 1:].flatten(1)], dim=1)
