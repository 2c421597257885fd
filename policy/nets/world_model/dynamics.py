"""Denoiser of the world model: a small factorised space-time transformer.

The tokens of an imagined frame are one for each patch of its latents, and one for the vehicle: its
motion and the stick that led to it. A layer attends over time at each place, then over each frame.
Attention over time is causal: a stick must not change earlier frames, although a pilot's later
sticks would reveal what the pilot saw.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import ACTION_DIM
from policy.nets.attention import Attention
from policy.nets.unet1d import TIME_DIM, sinusoid_frequencies
from policy.nets.world_model.config import HEAD_DIM, WorldModelConfig
from policy.nets.world_model.motion import MOTION_DIM, features_dim

MODULATIONS = 6
"""Scale and shift of each of a layer's three norms."""
_INITIAL_STD = 0.02
PREDICTOR_WIDTH = 192


@dataclass(frozen=True, kw_only=True)
class Future:
    """Unknown to denoise, or an estimate of it; every part has about unit scale.

    Latents are [B, T, C, h, w], motion is [B, T, MOTION_DIM], actions are [B, T, 4].
    """

    latents: Tensor
    motion: Tensor
    actions: Tensor


@dataclass(frozen=True, kw_only=True)
class Conditioning:
    """Inputs of the denoiser that are constant over the steps of a sample."""

    latents: Tensor
    """[B, K, C, h, w] of the past, oldest first."""
    features: Tensor
    """[B, D], see ``motion.context_features``."""
    knows_actions: Tensor
    """[B] bool: True if the future's actions are given, not noise."""
    predicted_motion: Tensor
    """[B, T, MOTION_DIM] of about unit scale."""
    warped: Tensor
    """[B, T, C, h, w] the newest frame, warped by the predicted motion."""
    in_view: Tensor
    """[B, T, 1, h, w] share of each warped cell that was in view."""


class LatentDynamics(nn.Module):
    """Network only; ``WorldModel.denoise`` defines the meaning of its output."""

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        frames, width, patch = config.frames, config.dynamics_width, config.patch
        self._patch, self._grid = patch, config.latent_shape[-1] // patch
        per_patch = config.latent_channels * patch * patch
        features = features_dim(config.context_frames)
        self.embed_patch = nn.Linear((2 + config.context_frames) * per_patch + patch * patch, width)
        self.embed_vehicle = nn.Linear(2 * (MOTION_DIM + ACTION_DIM) + 1, width)
        self.frame_position = nn.Parameter(_INITIAL_STD * torch.randn(frames, 1, width))
        self.slot_position = nn.Parameter(_INITIAL_STD * torch.randn(self._grid**2 + 1, width))
        self.condition = nn.Sequential(
            nn.Linear(TIME_DIM + features + 1, width),
            nn.SiLU(),
            nn.Linear(width, MODULATIONS * width),
        )
        self.layers = nn.ModuleList([_Layer(width) for _ in range(config.dynamics_depth)])
        self.norm = nn.LayerNorm(width)
        self.out_patch = nn.Linear(width, per_patch)
        self.out_vehicle = nn.Linear(width, MOTION_DIM + ACTION_DIM)
        for out in (self.out_patch, self.out_vehicle):  # a new network hardly changes its inputs
            nn.init.normal_(out.weight, std=_INITIAL_STD)
            nn.init.zeros_(out.bias)
        self._frequencies = nn.Buffer(sinusoid_frequencies(TIME_DIM), persistent=False)

    def forward(self, noisy: Future, timestep: Tensor, known: Conditioning) -> Future:
        """Return the network's outputs, shaped as the future, for a noisy future and step [B]."""
        frames = noisy.latents.shape[1]
        knows = known.knows_actions.to(noisy.motion.dtype).view(-1, 1)
        angle = timestep.to(self._frequencies.dtype).unsqueeze(-1) * self._frequencies
        inputs = torch.cat([angle.sin(), angle.cos(), known.features, knows], dim=-1)
        modulation = self.condition(inputs).unflatten(-1, (MODULATIONS, -1))
        past = known.latents.flatten(1, 2).unsqueeze(1).expand(-1, frames, -1, -1, -1)
        seen = torch.cat([noisy.latents, past, known.warped, known.in_view], dim=2)
        # [B, T, C, h, w] -> [B, T, patches, C * patch * patch], and back.
        cells = F.pixel_unshuffle(seen, self._patch).flatten(3).transpose(2, 3)
        patches = self.embed_patch(cells)
        knows_each = knows.unsqueeze(1).expand(-1, frames, -1)
        # Sticks are rates: their running sum nearly gives the motion.
        so_far = noisy.actions.cumsum(dim=1) / frames**0.5
        vehicle = torch.cat(
            [noisy.motion, known.predicted_motion, noisy.actions, so_far, knows_each], dim=-1
        )
        tokens = torch.cat([patches, self.embed_vehicle(vehicle).unsqueeze(2)], dim=2)
        tokens = tokens + self.frame_position + self.slot_position
        for layer in self.layers:
            tokens = layer(tokens, modulation)
        tokens = self.norm(tokens)
        motion, actions = self.out_vehicle(tokens[:, :, -1]).split([MOTION_DIM, ACTION_DIM], dim=-1)
        cells = self.out_patch(tokens[:, :, :-1]).transpose(2, 3).unflatten(3, (self._grid,) * 2)
        latents = F.pixel_shuffle(cells, self._patch)
        return Future(latents=latents, motion=motion, actions=actions)


class _Layer(nn.Module):
    """Attention over time, attention over a frame, and an MLP; [B, T, S, width] -> same shape."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.time, self.space = (Attention(width, width // HEAD_DIM) for _ in range(2))
        self.mlp = nn.Sequential(
            nn.Linear(width, 2 * width), nn.GELU(approximate="tanh"), nn.Linear(2 * width, width)
        )
        self.modulation = nn.Parameter(_INITIAL_STD * torch.randn(MODULATIONS, width))
        self._shape = (width,)

    def forward(self, tokens: Tensor, modulation: Tensor) -> Tensor:
        """Apply the layer; ``modulation`` [B, 6, width] is added to the layer's own."""
        table = (self.modulation + modulation)[:, :, None, None]
        scales, shifts = table[:, ::2], table[:, 1::2]

        def normed(index: int) -> Tensor:
            x = F.layer_norm(tokens, self._shape)
            return x * (1 + scales[:, index]) + shifts[:, index]

        by_place = normed(0).transpose(1, 2)
        over_time = self.time.among(by_place.flatten(0, 1), is_causal=True)
        tokens = tokens + over_time.reshape(by_place.shape).transpose(1, 2)
        by_frame = normed(1)
        tokens = tokens + self.space.among(by_frame.flatten(0, 1)).reshape(by_frame.shape)
        out: Tensor = tokens + self.mlp(normed(2))
        return out


class MotionPredictor(nn.Module):
    """Predicts the motion caused by the sticks, once, before denoising.

    A GRU over the sticks in the order in which they act: no stick changes earlier motion.
    """

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        features = features_dim(config.context_frames)
        self.initial_hidden = nn.Linear(features, PREDICTOR_WIDTH)
        self.gru = nn.GRU(2 * ACTION_DIM + 1 + features, PREDICTOR_WIDTH, batch_first=True)
        self.output = nn.Linear(PREDICTOR_WIDTH, MOTION_DIM)
        self.mean_motion = nn.Parameter(torch.zeros(config.frames, MOTION_DIM))
        nn.init.normal_(
            self.output.weight, std=_INITIAL_STD
        )  # a new network predicts the mean motion
        nn.init.zeros_(self.output.bias)

    def forward(self, features: Tensor, actions: Tensor, knows_actions: Tensor) -> Tensor:
        """Return motions [B, T, 15] for ``context_features`` [B, D] and actions [B, T, 4].

        Both inputs have about unit scale. Actions are ignored if ``knows_actions`` [B] is False.
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
