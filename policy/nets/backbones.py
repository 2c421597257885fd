"""The image encoders to choose from, and how ImageNet weights get into them.

Written here rather than imported, with torchvision's parameter names: a torchvision state dict
loads as it is, but for the 1000-class layer at its end, which ``load_imagenet_state`` leaves out.
"""

from collections.abc import Mapping
from typing import TypeAlias

from torch import Tensor, nn

from policy.errors import PolicyError
from policy.nets.convnext import ConvNextTiny
from policy.nets.efficientnet import EfficientNetB3
from policy.nets.names import BackboneName
from policy.nets.resnet import ResNet, ResNet8

Backbone: TypeAlias = EfficientNetB3 | ConvNextTiny | ResNet | ResNet8
"""Image [B, 3, H, W] normalised -> feature [B, out_dim]."""


def build_backbone(name: BackboneName) -> Backbone:
    """A backbone with random weights."""
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
    """Load torchvision's state dict of the same architecture; its classifier is left out."""
    kept = {name: value for name, value in state.items() if name not in backbone.classifier_keys}
    try:
        backbone.load_state_dict(kept)
    except RuntimeError as error:
        raise PolicyError(f"these weights are not of this backbone: {error}") from error
