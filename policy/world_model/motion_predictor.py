"""A first prediction of the motion that sticks lead to, made once, before anything is denoised."""

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM
from policy.world_model.config import WorldModelConfig
from policy.world_model.relative_state import MOTION_DIM, features_dim

WIDTH = 192
_INITIAL_STD = 0.02


class MotionPredictor(nn.Module):
    """A GRU over the sticks in the order in which they act: no stick changes what was before it."""

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        features = features_dim(config.context_frames)
        self.initial_hidden = nn.Linear(features, WIDTH)
        self.gru = nn.GRU(2 * ACTION_DIM + 1 + features, WIDTH, batch_first=True)
        self.output = nn.Linear(WIDTH, MOTION_DIM)
        self.mean_motion = nn.Parameter(torch.zeros(config.frames, MOTION_DIM))
        nn.init.normal_(self.output.weight, std=_INITIAL_STD)  # a new net predicts the mean motion
        nn.init.zeros_(self.output.bias)

    def forward(self, features: Tensor, actions: Tensor, knows_actions: Tensor) -> Tensor:
        """``relative_state.context_features`` [B, D], actions [B, T, 4] -> motions [B, T, 15].

        Both have about unit scale. Actions are ignored where ``knows_actions`` [B] is False.
        """
        known = knows_actions.view(-1, 1, 1)
        sticks = torch.where(known, actions, 0.0)
        so_far = sticks.cumsum(dim=1) / sticks.shape[1] ** 0.5
        start = torch.cat([known[:, 0].to(sticks.dtype), features], dim=-1)
        each = start.unsqueeze(1).expand(-1, sticks.shape[1], -1)
        hidden = torch.tanh(self.initial_hidden(features)).unsqueeze(0)
        read, _ = self.gru(torch.cat([sticks, so_far, each], dim=-1), hidden)
        motion: Tensor = self.output(read) + self.mean_motion
        return motion
