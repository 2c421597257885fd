"""Built-in networks: TOGE at two rates, and ResNet-UNet at one.

    image --backbone, projection--> feature --.
    state [B, 13 or 20] ----------------------+--MLP--> condition --diffusion head--> chunk
    action history [B, K, 4] --attention------'

In TOGE the path to the feature runs at the camera's rate, the rest at the action rate. ResNet-UNet
has no fast path, and takes the history as it is.
"""

from dataclasses import dataclass, field, replace
from typing import ClassVar

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM, Contract
from policy.errors import ContractError
from policy.nets.action_head import DiffusionHead, size_dims
from policy.nets.backbones import build_backbone
from policy.nets.diffusion import NoiseSchedule
from policy.nets.encoders import Fusion, HistoryEncoder, StateEncoder
from policy.nets.names import BackboneName, Size


@dataclass(frozen=True, kw_only=True)
class BuiltinConfig:
    """Architecture settings."""

    kind: ClassVar[str]
    """Name of the network in --policy and in checkpoints."""
    size: Size = "small"
    backbone: BackboneName
    contract: Contract = field(default_factory=Contract)
    """``feature_dim`` 0 is replaced by the network's own."""
    schedule: NoiseSchedule = field(default_factory=NoiseSchedule)

    @property
    def feature_dim(self) -> int:
        """``feature_dim`` of the contract."""
        return 0

    def __post_init__(self) -> None:
        if self.contract.feature_dim not in (0, self.feature_dim):
            raise ContractError(
                f"the contract says feature_dim {self.contract.feature_dim}, but {self.kind} "
                f"{self.size} has {self.feature_dim}: choose the size of the checkpoint"
            )
        if self.contract.arrays != "torch":
            raise ContractError(
                f"{self.kind} takes torch arrays, the contract says {self.contract.arrays}"
            )


class BuiltinPolicy(nn.Module):
    """Network behind ``protocol.SingleRatePolicy``, on torch tensors.

    Images are normalised by ``preprocess.image_to_input``, states are in SI units. Steps that the
    schedule does not have raise a ``PolicyError``. Chunks are sticks, even if the contract says
    rates: ``policy.stick_loop`` converts them.
    """

    head: DiffusionHead

    def __init__(self, config: BuiltinConfig) -> None:
        super().__init__()
        dim = size_dims(config.size).base_dim
        self.contract = replace(config.contract, feature_dim=config.feature_dim)
        self.config = replace(config, contract=self.contract)
        self.backbone = build_backbone(config.backbone)
        # The norm scales every backbone's feature like the other tokens.
        self.visual_projection = nn.Sequential(
            nn.Linear(self.backbone.out_dim, dim), nn.LayerNorm(dim)
        )
        self.state_encoder = StateEncoder(dim, self.contract)

    def condition(self, feature: Tensor, state_token: Tensor, action_history: Tensor) -> Tensor:
        """Fuse feature [B, F], encoded state [B, F], history [B, K, 4] -> condition [B, C]."""
        raise NotImplementedError

    def predict(
        self, image: Tensor, state: Tensor, action_history: Tensor, num_diffusion_steps: int
    ) -> Tensor:
        """Sample a chunk [B, horizon, 4] in [-1, 1] from image, state and history."""
        feature = self.visual_projection(self.backbone(image))
        return self._sample(feature, state, action_history, num_diffusion_steps)

    def _sample(self, feature: Tensor, state: Tensor, history: Tensor, steps: int) -> Tensor:
        condition = self.condition(feature, self.state_encoder(state), history)
        return self.head.sample(condition, steps)


@dataclass(frozen=True, kw_only=True)
class TogeConfig(BuiltinConfig):
    """Architecture settings of TOGE."""

    kind: ClassVar[str] = "toge"
    backbone: BackboneName = "efficientnet_b3"

    @property
    def feature_dim(self) -> int:
        """Width of the cached feature."""
        return size_dims(self.size).base_dim


class Toge(BuiltinPolicy):
    """TOGE behind ``protocol.DualRatePolicy``."""

    def __init__(self, config: TogeConfig) -> None:
        super().__init__(config)
        dim = config.feature_dim
        self.history_encoder = HistoryEncoder(dim // 4, self.contract.history_len)
        self.fusion = Fusion(dim, self.history_encoder.out_dim)
        self.head = DiffusionHead(config.size, self.contract, config.schedule)

    def condition(self, feature: Tensor, state_token: Tensor, action_history: Tensor) -> Tensor:
        """Fuse feature [B, F], encoded state [B, F], history [B, K, 4] -> condition [B, C]."""
        condition: Tensor = self.fusion(feature, state_token, self.history_encoder(action_history))
        return condition

    def encode_visual(self, image: Tensor) -> Tensor:
        """Encode an image [B, 3, H, W] -> feature [B, F]: the slow path."""
        feature: Tensor = self.visual_projection(self.backbone(image))
        return feature

    def predict_fast(
        self, feature: Tensor, state: Tensor, action_history: Tensor, num_diffusion_steps: int
    ) -> Tensor:
        """Sample a chunk from a cached feature: bit-identical to ``predict`` on its image."""
        return self._sample(feature, state, action_history, num_diffusion_steps)


@dataclass(frozen=True, kw_only=True)
class ResnetUnetConfig(BuiltinConfig):
    """Architecture settings of ResNet-UNet."""

    kind: ClassVar[str] = "resnet-unet"
    backbone: BackboneName = "resnet18"


class ResnetUnet(BuiltinPolicy):
    """Plain diffusion policy without a fast path."""

    def __init__(self, config: ResnetUnetConfig) -> None:
        super().__init__(config)
        dim = size_dims(config.size).base_dim
        history_dim = self.contract.history_len * ACTION_DIM
        self.fuse = nn.Sequential(
            nn.Linear(2 * dim + history_dim, 2 * dim), nn.SiLU(), nn.Linear(2 * dim, dim)
        )
        self.head = DiffusionHead(config.size, self.contract, config.schedule)

    def condition(self, feature: Tensor, state_token: Tensor, action_history: Tensor) -> Tensor:
        """Fuse feature [B, F], encoded state [B, F], history [B, K, 4] -> condition [B, C]."""
        condition: Tensor = self.fuse(
            torch.cat([feature, state_token, action_history.flatten(1)], dim=1)
        )
        return condition


def build_policy(config: BuiltinConfig) -> BuiltinPolicy:
    """Build the network of ``config``, with random weights from torch's global generator."""
    if isinstance(config, TogeConfig):
        return Toge(config)
    if isinstance(config, ResnetUnetConfig):
        return ResnetUnet(config)
    raise TypeError(f"no network has a {type(config).__name__}")
