"""ACT (Zhao et al. 2023) as LeRobot saves it: a transformer over image cells and a state.

Inference only: the encoder of the training latent is left out, and the latent is zero. Parameters
have LeRobot's names, except in the attention layers.
"""

import math
from collections.abc import Iterable

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.adapters.lerobot.base import LeRobotPolicy
from policy.adapters.lerobot.config import ActConfig, map_size
from policy.adapters.lerobot.plan import Plan
from policy.contract import ACTION_DIM
from policy.nets.attention import Attention
from policy.nets.resnet import LastMap

_ATTENTION_NAMES = {"in_proj_": "qkv.", "out_proj.": "project."}
"""Parts of LeRobot's parameter names, and ours."""


class EncoderLayer(nn.Module):
    """Self-attention and feed-forward layers, each with a norm before or after it."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        dim, hidden = config.dim_model, config.dim_feedforward
        self.self_attn = Attention(dim, config.n_heads)
        self.linear1, self.linear2 = nn.Linear(dim, hidden), nn.Linear(hidden, dim)
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.activation = F.gelu if config.feedforward_activation == "gelu" else F.relu
        self.pre_norm = config.pre_norm

    def forward(self, x: Tensor, position: Tensor) -> Tensor:
        """Encode [B, L, D]; positions are added to queries and keys only."""
        return self.feed_forward(self.attend(x, position), self.norm2)

    def attend(self, x: Tensor, position: Tensor) -> Tensor:
        """Apply self-attention and its shortcut."""
        own = self.before(x, self.norm1)
        at = own + position
        return self.after(x, self.self_attn(at, at, own), self.norm1)

    def feed_forward(self, x: Tensor, norm: nn.Module) -> Tensor:
        """Apply the two feed-forward layers and their shortcut."""
        hidden = self.activation(self.linear1(self.before(x, norm)))
        return self.after(x, self.linear2(hidden), norm)

    def before(self, x: Tensor, norm: nn.Module) -> Tensor:
        """Return the input of a sublayer."""
        return norm(x) if self.pre_norm else x

    def after(self, x: Tensor, change: Tensor, norm: nn.Module) -> Tensor:
        """Return the sum of a sublayer's output and its shortcut."""
        return x + change if self.pre_norm else norm(x + change)


class DecoderLayer(EncoderLayer):
    """Self-attention, attention to the encoder's tokens, and feed-forward layers."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__(config)
        self.norm3 = nn.LayerNorm(config.dim_model)
        self.multihead_attn = Attention(config.dim_model, config.n_heads)

    def forward(  # type: ignore[override]
        self, x: Tensor, position: Tensor, tokens: Tensor, token_position: Tensor
    ) -> Tensor:
        """Decode actions [B, L, D] and tokens [B, M, D], each with its positions."""
        x = self.attend(x, position)
        query = self.before(x, self.norm2) + position
        x = self.after(x, self.multihead_attn(query, tokens + token_position, tokens), self.norm2)
        return self.feed_forward(x, self.norm3)


class Stack(nn.Module):
    """Layers, and a norm after the last one."""

    def __init__(self, layers: Iterable[nn.Module], norm: nn.Module) -> None:
        super().__init__()
        self.layers, self.norm = nn.ModuleList(layers), norm

    def forward(self, x: Tensor, *others: Tensor) -> Tensor:
        """Apply all to [B, L, D]; ``others`` are the further arguments of each layer."""
        for layer in self.layers:
            x = layer(x, *others)
        out: Tensor = self.norm(x)
        return out


class Act(LeRobotPolicy):
    """Normalised images and state -> normalised actions.

    Tokens: the latent, the state if there is one, and the cells of each camera's map.
    """

    prefix = "model."

    def __init__(self, plan: Plan, config: ActConfig) -> None:
        super().__init__(plan)
        dim, state_dim = config.dim_model, config.features.state_dim
        self.cameras, self.latent_dim = len(config.features.image_keys), config.latent_dim
        self.backbone = LastMap(config.vision_backbone)
        self.encoder_img_feat_input_proj = nn.Conv2d(self.backbone.channels, dim, 1)
        self.encoder_latent_input_proj = nn.Linear(config.latent_dim, dim)
        self.encoder_robot_state_input_proj = nn.Linear(state_dim, dim) if state_dim else None
        self.encoder_1d_feature_pos_embed = nn.Embedding(2 if state_dim else 1, dim)
        norm = nn.LayerNorm(dim) if config.pre_norm else nn.Identity()
        self.encoder = Stack((EncoderLayer(config) for _ in range(config.n_encoder_layers)), norm)
        layers = (DecoderLayer(config) for _ in range(config.n_decoder_layers))
        self.decoder = Stack(layers, nn.LayerNorm(dim))
        self.decoder_pos_embed = nn.Embedding(config.chunk_size, dim)
        self.action_head = nn.Linear(dim, ACTION_DIM)
        cells = map_size(config.features.image_height, config.features.image_width)
        self._cell_position = nn.Buffer(cell_positions(*cells, dim), persistent=False)

    @staticmethod
    def own_name(name: str) -> str | None:
        """Return our name of a parameter in LeRobot's file, without the prefix; None: unused."""
        for theirs, ours in _ATTENTION_NAMES.items():
            name = name.replace(theirs, ours)
        return None if name.startswith("vae_encoder") else name

    def encode(self, image: Tensor, _camera: int) -> Tensor:
        """Encode a normalised image [B, 3, H, W] of any camera -> cells [B, D * h * w]."""
        cells: Tensor = self.encoder_img_feat_input_proj(self.backbone(image)).flatten(1)
        return cells

    def predict_fast(
        self, feature: Tensor, state: Tensor, action_history: Tensor, num_diffusion_steps: int
    ) -> Tensor:
        """Return a chunk [B, horizon, 4] for features [B, cameras * F] and states [B, S]."""
        feature, state = self.network_inputs(feature, state)
        batch, dim = feature.shape[0], self.encoder_latent_input_proj.out_features
        latent = torch.zeros(batch, self.latent_dim, dtype=feature.dtype, device=feature.device)
        tokens = [self.encoder_latent_input_proj(latent).unsqueeze(1)]
        if self.encoder_robot_state_input_proj is not None:
            tokens.append(self.encoder_robot_state_input_proj(state))
        tokens += [
            camera.reshape(batch, dim, -1).transpose(1, 2) for camera in feature[:, 0].unbind(1)
        ]
        position = torch.cat(
            [self.encoder_1d_feature_pos_embed.weight, *[self._cell_position] * self.cameras]
        ).unsqueeze(0)
        encoded = self.encoder(torch.cat(tokens, dim=1), position)
        of_actions = self.decoder_pos_embed.weight.unsqueeze(0)
        start = torch.zeros_like(of_actions).expand(batch, -1, -1)
        return self.in_units(self.action_head(self.decoder(start, of_actions, encoded, position)))


def cell_positions(height: int, width: int, dim: int) -> Tensor:
    """Return fixed positions of the cells of a map [height * width, dim]: rows, then columns.

    Alternating sine and cosine of the row or column, counted from 1 and scaled to 2 pi (DETR,
    Carion et al. 2020). Computed in float32, as in LeRobot.
    """
    half = dim // 2
    frequency = 10_000.0 ** (2 * (torch.arange(half, dtype=torch.float32) // 2) / half)

    def waves(count: int) -> Tensor:
        places = torch.arange(1, count + 1, dtype=torch.float32)
        angle = (places / (places[-1] + 1e-6) * (2 * math.pi)).unsqueeze(1) / frequency
        return torch.stack((angle[:, 0::2].sin(), angle[:, 1::2].cos()), dim=-1).flatten(1)

    rows = waves(height).unsqueeze(1).expand(-1, width, -1)
    columns = waves(width).unsqueeze(0).expand(height, -1, -1)
    return torch.cat((rows, columns), dim=-1).flatten(0, 1)
