"""A group norm that OpenVINO computes fast, and without falling over."""

import torch.nn.functional as F
from torch import Tensor, nn


class GroupNorm(nn.GroupNorm):
    """The same function, written as a layer norm of each group.

    OpenVINO's CPU plugin takes a group norm apart into slower parts; and 2026.4 ends the process by
    a segmentation fault where it compiles a ResNet-18 with group norms in float32.
    """

    def forward(self, x: Tensor) -> Tensor:
        """[B, C, ...] -> the same shape."""
        groups = x.reshape(x.shape[0], self.num_groups, -1)
        normed = F.layer_norm(groups, [int(groups.shape[-1])], eps=self.eps).reshape(x.shape)
        channels = [-1, *[1] * (x.ndim - 2)]
        return normed * self.weight.reshape(channels) + self.bias.reshape(channels)
