"""The built-in network, TOGE: at the camera's rate to the feature, the rest at the action rate.

image --backbone, projection--> feature --.
state [B, 13 or 20] ----------------------+--MLP--> condition --diffusion head--> chunk
action history [B, K, 4] --attention------'
"""

from dataclasses import dataclass, field, replace

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM, Contract
from policy.errors import ContractError, PolicyError
from policy.fields import require_fields
from policy.nets.attention import Attention, is_tracing
from policy.nets.diffusion import SIZE_DIMS, DiffusionHead, NoiseSchedule
from policy.nets.names import BackboneName, Size
from policy.nets.resnet import build_backbone
from policy.preprocess import egocentric_columns, egocentric_scale
from policy.protocol import predict_by_pair

HEADS = 4


class StateEncoder(nn.Module):
    """State [B, state_dim] in SI units -> token [B, dim]."""

    def __init__(self, dim: int, contract: Contract) -> None:
        super().__init__()
        is_plain = len(contract.cameras) == 1 and contract.observation_steps == 1
        if not is_plain or contract.state_extras or contract.is_depth:
            raise ContractError(
                "the networks of this project take the newest image of one camera in colour and "
                f"the newest state; the contract asks for {contract.image_channels} of cameras "
                f"{list(contract.cameras)}, "
                f"{contract.observation_steps} observations and extras "
                f"{list(contract.state_extras)}: use a policy class of your own"
            )
        scale = egocentric_scale(contract)
        self.mlp = nn.Sequential(nn.Linear(len(scale), dim), nn.SiLU(), nn.Linear(dim, dim))
        self._scale = nn.Buffer(torch.tensor(scale), persistent=False)

    def normalise(self, state: Tensor) -> Tensor:
        """Convert states [B, state_dim] in SI units to numbers [B, state_dim - 1] of about 1."""
        return torch.stack(egocentric_columns(state.unbind(1)), dim=1) / self._scale

    def forward(self, state: Tensor) -> Tensor:
        """Encode a state [B, state_dim] -> token [B, dim]."""
        token: Tensor = self.mlp(self.normalise(state))
        return token


class AttentionBlock(Attention):
    """Self-attention and an MLP, each after a norm, around a shortcut; [B, T, dim] -> same."""

    def __init__(self, dim: int) -> None:
        super().__init__(dim, HEADS)
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, 2 * dim), nn.SiLU(), nn.Linear(2 * dim, dim))

    def transform(self, tokens: Tensor) -> Tensor:
        """Transform tokens [B, T, dim] to the same shape, each informed by all."""
        tokens = tokens + self.among(self.norm1(tokens), plainly=is_tracing())
        out: Tensor = tokens + self.mlp(self.norm2(tokens))
        return out


class HistoryEncoder(nn.Module):
    """Past actions [B, K, 4], oldest first, through self-attention -> [B, out_dim]."""

    def __init__(self, dim: int, history_len: int) -> None:
        super().__init__()
        self.out_dim = history_len * dim
        self.embed = nn.Linear(ACTION_DIM, dim)
        self.position = nn.Parameter(0.02 * torch.randn(1, history_len, dim))
        self.attention = AttentionBlock(dim)

    def forward(self, action_history: Tensor) -> Tensor:
        """Encode past actions [B, K, 4] -> concatenated tokens [B, K * dim]."""
        tokens = self.attention.transform(self.embed(action_history) + self.position)
        return tokens.flatten(1)


class Fusion(nn.Module):
    """Visual token, state token and encoded history -> condition [B, dim].

    The right sticks depend jointly on the view and on the vehicle's motion. That takes depth, and
    depth is cheapest here: a layer costs a hundredth of the denoiser. In equal training time,
    attention among the tokens reached a stick error of 0.091, this network 0.085.
    """

    def __init__(self, dim: int, history_dim: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(
            nn.Linear(2 * dim + history_dim, 2 * dim),
            nn.SiLU(),
            nn.Linear(2 * dim, 2 * dim),
            nn.SiLU(),
            nn.Linear(2 * dim, 2 * dim),
            nn.SiLU(),
            nn.Linear(2 * dim, dim),
        )

    def forward(self, visual: Tensor, state: Tensor, history: Tensor) -> Tensor:
        """Fuse visual and state tokens [B, dim], history [B, history_dim] -> condition [B, dim]."""
        condition: Tensor = self.mlp(torch.cat([visual, state, history], dim=1))
        return condition


@dataclass(frozen=True, kw_only=True)
class TogeConfig:
    """Architecture settings."""

    size: Size = "small"
    backbone: BackboneName = "resnet8"
    contract: Contract = field(default_factory=Contract)
    """``feature_dim`` 0 is replaced by the network's own."""
    schedule: NoiseSchedule = field(default_factory=NoiseSchedule)

    @property
    def feature_dim(self) -> int:
        """Width of the cached feature."""
        return SIZE_DIMS[self.size].base_dim

    def __post_init__(self) -> None:
        require_fields(self, PolicyError)
        if self.contract.feature_dim not in (0, self.feature_dim):
            raise ContractError(
                f"the contract says feature_dim {self.contract.feature_dim}, but toge {self.size} "
                f"has {self.feature_dim}: choose the size of the checkpoint"
            )
        if self.contract.arrays != "torch":
            raise ContractError(
                f"toge takes torch arrays, the contract says {self.contract.arrays}"
            )
        if self.contract.prefix_len:
            raise ContractError("toge takes no prefix: leave prefix_len out")
        if self.schedule.prediction != "sample":
            raise PolicyError("the schedule of toge must predict the sample")


class Toge(nn.Module):
    """TOGE behind ``protocol.StepwisePolicy``, on torch tensors.

    Images are normalised by ``preprocess.image_to_input``, states are in SI units. Steps that the
    schedule does not have raise a ``PolicyError``. Chunks are sticks, even if the contract says
    rates: ``policy.motion.stick_loop`` converts them.
    """

    def __init__(self, config: TogeConfig) -> None:
        """Build the network with random weights from torch's global generator."""
        super().__init__()
        dim = config.feature_dim
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

    def condition(self, feature: Tensor, state_token: Tensor, action_history: Tensor) -> Tensor:
        """Fuse feature [B, F], encoded state [B, F], history [B, K, 4] -> condition [B, C]."""
        condition: Tensor = self.fusion(feature, state_token, self.history_encoder(action_history))
        return condition

    def encode_visual(self, image: Tensor) -> Tensor:
        """Encode an image [B, 3, H, W] -> feature [B, F]: the slow path."""
        feature: Tensor = self.visual_projection(self.backbone(image))
        return feature

    def denoise(
        self,
        noisy: Tensor,
        timestep: Tensor,
        feature: Tensor,
        state: Tensor,
        action_history: Tensor,
    ) -> Tensor:
        """Call the network once on noisy actions [B, horizon, 4] at timesteps [B]."""
        condition = self.condition(feature, self.state_encoder(state), action_history)
        return self.head.denoise(noisy, timestep, condition)

    def predict_fast(
        self, feature: Tensor, state: Tensor, action_history: Tensor, num_diffusion_steps: int
    ) -> Tensor:
        """Sample a chunk [B, horizon, 4] in [-1, 1] from feature, state and history."""
        condition = self.condition(feature, self.state_encoder(state), action_history)
        return self.head.sample(condition, num_diffusion_steps)

    predict = predict_by_pair

    @property
    def schedule(self) -> NoiseSchedule:
        """The noise schedule of the training."""
        return self.config.schedule

    @property
    def initial_noise(self) -> Tensor:
        """[1, horizon, 4]; fixed for a whole flight."""
        return self.head.initial_noise

    def to_chunk(self, sample: Tensor) -> Tensor:
        """Return the end of a solve as it is."""
        return sample
