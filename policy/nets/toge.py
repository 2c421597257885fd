"""TOGE, the dual-rate vision policy: a slow image path, a fast action path, one condition.

    image --backbone, projection--> feature --.
    state [B, 13 or 20] ----------------------+--MLP--> condition --diffusion head--> chunk
    action history [B, K, 4] --attention------'

The path to the feature runs at the camera's rate, the rest at the action rate.
"""

from dataclasses import dataclass, field, replace

from torch import Tensor, nn

from policy.contract import ACTION_DIM, Contract
from policy.errors import ContractError, PolicyError
from policy.nets.action_head import DiffusionHead, size_dims
from policy.nets.backbones import build_backbone
from policy.nets.diffusion import NoiseSchedule
from policy.nets.encoders import Fusion, HistoryEncoder, StateEncoder, require_shape
from policy.nets.names import BACKBONE_NAMES, BackboneName, Size


@dataclass(frozen=True, kw_only=True)
class TogeConfig:
    """Architecture settings of TOGE."""

    size: Size = "small"
    backbone: BackboneName = "efficientnet_b3"
    contract: Contract = field(default_factory=Contract)
    """``feature_dim`` 0 is replaced by the size's own."""
    schedule: NoiseSchedule = field(default_factory=NoiseSchedule)

    def __post_init__(self) -> None:
        if self.backbone not in BACKBONE_NAMES:
            raise PolicyError(
                f"backbone {self.backbone!r} is unknown; use one of {list(BACKBONE_NAMES)}"
            )
        feature_dim = size_dims(self.size).base_dim
        if self.contract.feature_dim not in (0, feature_dim):
            raise ContractError(
                f"the contract says feature_dim {self.contract.feature_dim}, but TOGE "
                f"{self.size} has {feature_dim}: choose the size that the checkpoint was made with"
            )
        if self.contract.arrays != "torch":
            raise ContractError(
                f"TOGE takes torch arrays, the contract says {self.contract.arrays}"
            )


class Toge(nn.Module):
    """TOGE behind ``protocol.DualRatePolicy``, on torch tensors.

    Images are normalised by ``preprocess.image_to_input``, states are in SI units. A shape that
    differs from the contract's, or steps that the schedule does not have, raise a ``PolicyError``.
    Chunks are sticks, even if the contract says rates: ``policy.stick_loop`` converts them.
    """

    def __init__(self, config: TogeConfig) -> None:
        super().__init__()
        dim = size_dims(config.size).base_dim
        self.contract = replace(config.contract, feature_dim=dim)
        self.config = replace(config, contract=self.contract)
        self.backbone = build_backbone(config.backbone)
        # The norm scales every backbone's feature like the other tokens.
        self.visual_projection = nn.Sequential(
            nn.Linear(self.backbone.out_dim, dim), nn.LayerNorm(dim)
        )
        self.state_encoder = StateEncoder(dim, self.contract)
        self.history_encoder = HistoryEncoder(dim // 4, self.contract.history_len)
        self.fusion = Fusion(dim, self.history_encoder.out_dim)
        self.head = DiffusionHead(config.size, self.contract, config.schedule)

    def seed_noise(self, seed: int) -> None:
        """Start a flight: draw the initial noise of all its samples."""
        self.head.seed_noise(seed)

    def encode_visual(self, image: Tensor) -> Tensor:
        """Encode an image [B, 3, H, W] -> feature [B, F]: the slow path."""
        require_shape("image", image, 3, self.contract.image_height, self.contract.image_width)
        feature: Tensor = self.visual_projection(self.backbone(image))
        return feature

    def encode_and_fuse(
        self, feature: Tensor, state: Tensor, action_history: Tensor | None = None
    ) -> Tensor:
        """Fuse feature [B, F], state [B, state_dim], history [B, K, 4] or None -> condition [B, C].

        None: no action was sent yet. In training, such histories are centred sticks.
        """
        require_shape("feature", feature, self.contract.feature_dim)
        require_shape("state", state, self.contract.state_dim)
        if action_history is None:
            action_history = state.new_zeros(len(state), self.contract.history_len, ACTION_DIM)
        require_shape("action_history", action_history, self.contract.history_len, ACTION_DIM)
        return self.condition(feature, self.state_encoder(state), action_history)

    def encode_observation(
        self, image: Tensor, state: Tensor, action_history: Tensor | None = None
    ) -> Tensor:
        """Call ``encode_visual``, then ``encode_and_fuse``: image, state, history -> condition."""
        return self.encode_and_fuse(self.encode_visual(image), state, action_history)

    def condition(self, feature: Tensor, state_token: Tensor, action_history: Tensor) -> Tensor:
        """Fuse feature [B, F], encoded state [B, F], history [B, K, 4] -> condition [B, C]."""
        condition: Tensor = self.fusion(feature, state_token, self.history_encoder(action_history))
        return condition

    def predict_fast(
        self,
        feature: Tensor,
        state: Tensor,
        action_history: Tensor | None = None,
        num_diffusion_steps: int = 10,
    ) -> Tensor:
        """Sample a chunk [B, horizon, 4] in [-1, 1] from cached feature, state and history."""
        condition = self.encode_and_fuse(feature, state, action_history)
        return self.head.sample(condition, num_diffusion_steps)

    def predict(
        self,
        image: Tensor,
        state: Tensor,
        action_history: Tensor | None = None,
        num_diffusion_steps: int = 10,
    ) -> Tensor:
        """Encode the image, then call ``predict_fast``: bit-identical to the two separate calls."""
        feature = self.encode_visual(image)
        return self.predict_fast(feature, state, action_history, num_diffusion_steps)
