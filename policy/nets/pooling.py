"""From a feature map to a vector that still says where things are.

The usual average over the map answers what is in the image and forgets where; steering needs both.
Diffusion policies therefore pool by spatial softmax (Chi et al., "Diffusion Policy", 2023). First
moments do the same without a parameter, at any image size, and beside the average that ImageNet's
weights were trained with.
"""

import math

import numpy as np
import torch
from torch import Tensor

from policy.contract import FloatArray

MOMENTS = 3
"""The average, and the averages weighted by the place to the right and by the place below."""


def moments(features: Tensor) -> Tensor:
    """Map [B, C, H, W] -> [B, 3, C]."""
    height, width = (int(size) for size in features.shape[2:])  # plain numbers also in a trace
    weights = torch.from_numpy(moment_weights(height, width)).to(features)
    return torch.matmul(features.flatten(2), weights).transpose(1, 2)


def moment_weights(height: int, width: int) -> FloatArray:
    """[H * W, 3]: what each cell counts; places have mean 0 and variance of about 1."""
    across = np.broadcast_to(_places(width), (height, width))
    down = np.broadcast_to(_places(height)[:, None], (height, width))
    weights = np.stack([np.ones_like(across), across, down], axis=-1).reshape(-1, MOMENTS)
    return (weights / (height * width)).astype(np.float32)


def _places(count: int) -> FloatArray:
    """Centres of ``count`` cells from one border to the other, at -sqrt(3) and sqrt(3)."""
    centres = (np.arange(count, dtype=np.float32) + 0.5) * (2.0 / count) - 1.0
    return (math.sqrt(3.0) * centres).astype(np.float32)
