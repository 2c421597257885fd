"""ResNet-UNet: a plain diffusion policy without a fast path; it flies in single-rate mode."""

from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM, Contract
from policy.errors import ContractError
from policy.nets.action_head import DiffusionHead, size_dims
from policy.nets.backbones import build_backbone
from policy.nets.diffusion import NoiseSchedule
from policy.nets.encoders import StateEncoder, require_shape
from policy.nets.names import Size


@dataclass(frozen=True, kw_only=True)
class ResnetUnetConfig:
    """Architecture settings."""

    size: Size = "small"
    contract: Contract = field(default_factory=Contract)
    schedule: NoiseSchedule = field(default_factory=NoiseSchedule)

    def __post_init__(self) -> None:
        size_dims(self.size)
        if self.contract.feature_dim != 0 or self.contract.arrays != "torch":
            raise ContractError(
                "ResNet-UNet has no cached feature and takes torch arrays: its contract needs "
                f"feature_dim 0 and arrays 'torch', got {self.contract.feature_dim} and "
                f"{self.contract.arrays!r}"
            )


class ResnetUnet(nn.Module):
    """ResNet-UNet behind ``protocol.SingleRatePolicy``, on torch tensors.

    Chunks are sticks, even if the contract says rates: ``policy.stick_loop`` converts them.
    """

    def __init__(self, config: ResnetUnetConfig) -> None:
        super().__init__()
        dim = size_dims(config.size).base_dim
        self.contract = config.contract
        self.config = config
        self.backbone = build_backbone("resnet18")
        self.state_encoder = StateEncoder(dim, self.contract)
        self.visual_projection = nn.Sequential(
            nn.Linear(self.backbone.out_dim, dim), nn.LayerNorm(dim)
        )
        history_dim = self.contract.history_len * ACTION_DIM
        self.fuse = nn.Sequential(
            nn.Linear(2 * dim + history_dim, 2 * dim), nn.SiLU(), nn.Linear(2 * dim, dim)
        )
        self.head = DiffusionHead(config.size, self.contract, config.schedule)

    def seed_noise(self, seed: int) -> None:
        """Start a flight: draw the initial noise of all its samples."""
        self.head.seed_noise(seed)

    def condition(self, visual: Tensor, state_token: Tensor, action_history: Tensor) -> Tensor:
        """Fuse image [B, C], encoded state [B, C], history [B, K, 4] -> condition [B, C]."""
        parts = [visual, state_token, action_history.flatten(1)]
        condition: Tensor = self.fuse(torch.cat(parts, dim=1))
        return condition

    def encode_observation(
        self, image: Tensor, state: Tensor, action_history: Tensor | None = None
    ) -> Tensor:
        """Encode image, state, history [B, K, 4] or None (no action sent) -> condition [B, C]."""
        contract = self.contract
        if action_history is None:
            action_history = state.new_zeros(len(state), contract.history_len, ACTION_DIM)
        require_shape("image", image, 3, contract.image_height, contract.image_width)
        require_shape("state", state, contract.state_dim)
        require_shape("action_history", action_history, contract.history_len, ACTION_DIM)
        visual = self.visual_projection(self.backbone(image))
        return self.condition(visual, self.state_encoder(state), action_history)

    def predict(
        self,
        image: Tensor,
        state: Tensor,
        action_history: Tensor | None = None,
        num_diffusion_steps: int = 10,
    ) -> Tensor:
        """Sample a chunk [B, horizon, 4] in [-1, 1] from image, state and history."""
        condition = self.encode_observation(image, state, action_history)
        return self.head.sample(condition, num_diffusion_steps)
