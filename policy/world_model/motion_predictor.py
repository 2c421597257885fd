"""A first guess of the motion that sticks lead to, made once and before anything is denoised."""

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM
from policy.world_model.relative_state import MOTION_DIM

_SMALL = 0.02


class Foresight(nn.Module):
    """Reads the sticks in the order in which they will act; a stick changes nothing before it."""

    def __init__(self, *, features: int, frames: int, width: int = 192) -> None:
        super().__init__()
        self.begin = nn.Linear(features, width)
        self.read = nn.GRU(2 * ACTION_DIM + 1 + features, width, batch_first=True)
        self.tell = nn.Linear(width, MOTION_DIM)
        self.usual = nn.Parameter(torch.zeros(frames, MOTION_DIM))
        nn.init.normal_(self.tell.weight, std=_SMALL)  # a new net foresees the mean motion
        nn.init.zeros_(self.tell.bias)

    def forward(self, features: Tensor, actions: Tensor, knows_actions: Tensor) -> Tensor:
        """Motions [B, T, MOTION_DIM] of about unit scale.

        Args:
            features: [B, D], see ``relative_state.context_features``.
            actions: [B, T, 4] of about unit scale; not looked at where they are not known.
            knows_actions: [B] bool.
        """
        known = knows_actions.view(-1, 1, 1)
        sticks = torch.where(known, actions, 0.0)
        so_far = sticks.cumsum(dim=1) / sticks.shape[1] ** 0.5
        of_start = torch.cat([known[:, 0].to(sticks.dtype), features], dim=-1)
        each = of_start.unsqueeze(1).expand(-1, sticks.shape[1], -1)
        begun = torch.tanh(self.begin(features)).unsqueeze(0)
        read, _ = self.read(torch.cat([sticks, so_far, each], dim=-1), begun)
        motion: Tensor = self.tell(read) + self.usual
        return motion
