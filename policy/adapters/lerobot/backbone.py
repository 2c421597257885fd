"""The ResNet of a LeRobot policy: torchvision's, without its last two layers."""

from torch import Tensor, nn

from policy.adapters.lerobot.group_norm import GroupNorm
from policy.nets.resnet import BasicBlock, Bottleneck, ResNet

_DEPTHS: dict[str, tuple[type[BasicBlock] | type[Bottleneck], tuple[int, int, int, int]]] = {
    "resnet18": (BasicBlock, (2, 2, 2, 2)),
    "resnet34": (BasicBlock, (3, 4, 6, 3)),
    "resnet50": (Bottleneck, (3, 4, 6, 3)),
    "resnet101": (Bottleneck, (3, 4, 23, 3)),
    "resnet152": (Bottleneck, (3, 8, 36, 3)),
}
_PLACES = {"0": "conv1", "1": "bn1", "4": "layer1", "5": "layer2", "6": "layer3", "7": "layer4"}
_CHANNELS_PER_GROUP = 16


class Backbone(ResNet):
    """Image [B, 3, H, W] -> its last map [B, channels, ceil(H / 32), ceil(W / 32)]."""

    def __init__(self, name: str, *, group_norm: bool) -> None:
        block, depths = _DEPTHS[name]
        super().__init__(block, depths)
        self.channels = 512 * block.expansion
        if group_norm:
            _replace_batch_norms(self)

    def forward(self, image: Tensor) -> Tensor:
        """The last map itself."""
        return self.last_map(image)


def torchvision_name(name: str) -> str:
    """``4.0.conv1.weight``, by places in a list of layers, -> ``layer1.0.conv1.weight``."""
    place, _, rest = name.partition(".")
    return f"{_PLACES.get(place, place)}.{rest}"


def _replace_batch_norms(module: nn.Module) -> None:
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            channels = child.num_features
            setattr(module, name, GroupNorm(channels // _CHANNELS_PER_GROUP, channels))
        else:
            _replace_batch_norms(child)
