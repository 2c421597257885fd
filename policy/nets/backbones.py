"""Image encoders, and the loading of ImageNet weights into them.

Written here instead of imported, with torchvision's parameter names: a torchvision state dict loads
unchanged, except for the final 1000-class layer, which ``load_imagenet_state`` drops.
"""

from collections.abc import Mapping
from typing import TypeAlias

import torch
from torch import Tensor, nn

from policy.errors import PolicyError
from policy.nets.depthwise import Depthwise
from policy.nets.names import BackboneName
from policy.nets.resnet import MOMENTS, ResNet, ResNet8, moments

STEM_CHANNELS = 40
# expand ratio, kernel, stride, channels out, depth: B0's table at width 1.2 and depth 1.4
STAGES = (
    (1, 3, 1, 24, 2),
    (6, 3, 2, 32, 3),
    (6, 5, 2, 48, 3),
    (6, 3, 2, 96, 5),
    (6, 5, 1, 136, 5),
    (6, 5, 2, 232, 6),
    (6, 3, 1, 384, 2),
)
OUT_CHANNELS = 1536
WIDTHS = (96, 192, 384, 768)
DEPTHS = (3, 3, 9, 3)
NORM_EPS = 1e-6


class SqueezeExcitation(nn.Module):
    """Scaling of each channel by a gate of the pooled channels; [B, C, H, W] -> same shape."""

    def __init__(self, channels: int, squeezed: int) -> None:
        super().__init__()
        self.fc1 = nn.Conv2d(channels, squeezed, 1)
        self.fc2 = nn.Conv2d(squeezed, channels, 1)
        self.activation = nn.SiLU()

    def forward(self, x: Tensor) -> Tensor:
        """Gate ``x``."""
        if self.training:  # the gradient of mean is a tensor of x's size, its axes out of order
            pooled = x.sum(dim=(2, 3), keepdim=True) * (1.0 / x[0, 0].numel())
        else:
            pooled = x.mean(dim=(2, 3), keepdim=True)
        return x * torch.sigmoid(self.fc2(self.activation(self.fc1(pooled))))


class MBConv(nn.Module):
    """Expand, filter per channel, gate, project; with a shortcut if the shape allows."""

    def __init__(
        self, channels_in: int, channels_out: int, *, expand: int, kernel: int, stride: int
    ) -> None:
        super().__init__()
        hidden = channels_in * expand
        layers: list[nn.Module] = []
        if expand != 1:
            layers.append(_conv_norm(channels_in, hidden, 1))
        layers += [
            _norm_after(Depthwise(hidden, kernel, stride=stride), hidden),
            SqueezeExcitation(hidden, max(1, channels_in // 4)),
            _conv_norm(hidden, channels_out, 1, activation=False),
        ]
        self.block = nn.Sequential(*layers)
        self.has_shortcut = stride == 1 and channels_in == channels_out

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C_in, H, W] -> [B, C_out, H/stride, W/stride]."""
        out: Tensor = self.block(x)
        return out + x if self.has_shortcut else out


class EfficientNetB3(nn.Module):
    """Image [B, 3, H, W] -> moments [B, 3 * 1536]; without torchvision's ``classifier``."""

    classifier_keys = ("classifier.1.weight", "classifier.1.bias")

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = [_conv_norm(3, STEM_CHANNELS, 3, stride=2)]
        channels = STEM_CHANNELS
        for expand, kernel, stride, channels_out, depth in STAGES:
            blocks = [MBConv(channels, channels_out, expand=expand, kernel=kernel, stride=stride)]
            channels = channels_out
            for _ in range(depth - 1):
                blocks.append(MBConv(channels, channels, expand=expand, kernel=kernel, stride=1))
            layers.append(nn.Sequential(*blocks))
        layers.append(_conv_norm(channels, OUT_CHANNELS, 1))
        self.features = nn.Sequential(*layers)
        self.out_dim = MOMENTS * OUT_CHANNELS

    def forward(self, image: Tensor) -> Tensor:
        """Return ``resnet.moments`` of the last map, flattened."""
        return moments(self.features(image)).flatten(1)


def _conv_norm(
    channels_in: int, channels_out: int, kernel: int, *, stride: int = 1, activation: bool = True
) -> nn.Sequential:
    conv = nn.Conv2d(channels_in, channels_out, kernel, stride, kernel // 2, bias=False)
    return _norm_after(conv, channels_out, activation=activation)


def _norm_after(conv: nn.Conv2d, channels: int, *, activation: bool = True) -> nn.Sequential:
    layers: list[nn.Module] = [conv, nn.BatchNorm2d(channels)]
    if activation:
        layers.append(nn.SiLU())  # in place, training would copy its input first
    return nn.Sequential(*layers)


class ChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of [B, C, H, W]."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise the channels of [B, C, H, W]."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


class Permute(nn.Module):
    """Reordering of axes; a module because it holds an index in torchvision's parameter names."""

    def __init__(self, *axes: int) -> None:
        super().__init__()
        self.axes = axes

    def forward(self, x: Tensor) -> Tensor:
        """Return ``x`` with its axes reordered."""
        return x.permute(self.axes)


class ConvNextBlock(nn.Module):
    """Depthwise 7x7, then a per-position MLP, scaled, around a shortcut."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.block = nn.Sequential(
            Depthwise(channels, 7, bias=True),
            Permute(0, 2, 3, 1),
            nn.LayerNorm(channels, eps=NORM_EPS),
            nn.Linear(channels, 4 * channels),
            nn.GELU(),
            nn.Linear(4 * channels, channels),
            Permute(0, 3, 1, 2),
        )
        self.layer_scale = nn.Parameter(torch.full((channels, 1, 1), 1e-6))

    def forward(self, x: Tensor) -> Tensor:
        """Map [B, C, H, W] to the same shape."""
        out: Tensor = x + self.layer_scale * self.block(x)
        return out


class ConvNextTiny(nn.Module):
    """Image [B, 3, H, W] -> moments [B, 3 * 768].

    The norm of their average has torchvision's name ``classifier.0``; the linear layer after it,
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
        """Return ``resnet.moments`` of the last map, flattened, with the average normalised."""
        features = self.features(image)
        average = self.classifier(features.mean(dim=(2, 3), keepdim=True))
        return torch.cat([average, moments(features)[:, 1:].flatten(1)], dim=1)


Backbone: TypeAlias = EfficientNetB3 | ConvNextTiny | ResNet | ResNet8
"""Normalised image [B, 3, H, W] -> feature [B, out_dim]."""


def build_backbone(name: BackboneName) -> Backbone:
    """Build a backbone with random weights."""
    backbone: Backbone
    match name:
        case "efficientnet_b3":
            backbone = EfficientNetB3()
        case "convnext_tiny":
            backbone = ConvNextTiny()
        case "resnet8":
            backbone = ResNet8()
        case _:
            backbone = ResNet(name)
    # He et al. 2015, fan-in: the signal survives the depth before any batch norm has statistics.
    # With torch's own default an untrained EfficientNet-B3 maps every image to about 1e-13.
    for module in backbone.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, mode="fan_in", nonlinearity="relu")
            if module.bias is not None:
                nn.init.zeros_(module.bias)
    return backbone


def load_imagenet_state(backbone: Backbone, state: Mapping[str, Tensor]) -> None:
    """Load torchvision's state dict of the same architecture, without its classifier."""
    kept = {name: value for name, value in state.items() if name not in backbone.classifier_keys}
    try:
        backbone.load_state_dict(kept)
    except RuntimeError as error:
        raise PolicyError(f"these weights are not of this backbone: {error}") from error
