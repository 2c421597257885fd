"""A policy in torch, at two rates: holds 2.8 m above home and turns to the brighter side.

make fly POLICY=./examples/torch_policy.py:TowardsLight DURATION=20
"""

import torch
from torch import nn

from policy.contract import Contract


class TowardsLight(nn.Module):
    contract = Contract(feature_dim=2, state_extras=("height",), image_height=48, image_width=64)

    def encode_visual(self, image):  # [1, 3, H, W], some 30 times a second
        return nn.functional.adaptive_avg_pool2d(image.mean(1), (1, 2)).flatten(1)

    def predict_fast(self, feature, state, action_history, num_diffusion_steps):  # at up to 100 Hz
        throttle = (3.0 - state[:, -1]).clamp(-0.5, 0.5)
        yaw = (feature[:, 1] - feature[:, 0]).clamp(-0.3, 0.3)
        sticks = torch.stack([throttle, yaw, 0 * yaw, 0 * yaw], dim=-1)
        return sticks[:, None].repeat(1, self.contract.horizon, 1)
