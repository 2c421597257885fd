"""ACT (Zhao et al. 2023) as LeRobot saves it: a ResNet's cells and a state, through a transformer.

Only what inference needs: the encoder of the training's latent is left out, and the latent is zero.
Parameters have LeRobot's names.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.adapters.lerobot.backbone import Backbone
from policy.adapters.lerobot.config import ActConfig, map_size
from policy.contract import ACTION_DIM


class Attention(nn.Module):
    """Attention of several heads over [B, L, D], with the parameters of ``nn.MultiheadAttention``.

    That class traces to one operation of torch's own, which no other engine knows.
    """

    def __init__(self, dim: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.in_proj_weight = nn.Parameter(torch.empty(3 * dim, dim))
        self.in_proj_bias = nn.Parameter(torch.empty(3 * dim))
        self.out_proj = nn.Linear(dim, dim)

    def forward(self, query: Tensor, key: Tensor, value: Tensor) -> Tensor:
        """Query [B, L, D], key and value [B, M, D] -> [B, L, D]."""
        weights, biases = self.in_proj_weight.chunk(3), self.in_proj_bias.chunk(3)
        q, k, v = (
            F.linear(x, weight, bias).reshape(*x.shape[:2], self.heads, -1).transpose(1, 2)
            for x, weight, bias in zip((query, key, value), weights, biases, strict=True)
        )
        mixed = F.scaled_dot_product_attention(q, k, v)
        out: Tensor = self.out_proj(mixed.transpose(1, 2).flatten(2))
        return out


class FeedForward(nn.Module):
    """The part of a layer that both kinds of layers share."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        dim, hidden = config.dim_model, config.dim_feedforward
        self.linear1, self.linear2 = nn.Linear(dim, hidden), nn.Linear(hidden, dim)
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.gelu = config.feedforward_activation == "gelu"
        self.pre_norm = config.pre_norm

    def before(self, x: Tensor, norm: nn.Module) -> Tensor:
        """What a sublayer takes."""
        return norm(x) if self.pre_norm else x

    def after(self, x: Tensor, change: Tensor, norm: nn.Module) -> Tensor:
        """What a sublayer gives."""
        return x + change if self.pre_norm else norm(x + change)

    def feed_forward(self, x: Tensor) -> Tensor:
        """Two layers, [B, L, D]."""
        hidden = self.linear1(x)
        out: Tensor = self.linear2(F.gelu(hidden) if self.gelu else F.relu(hidden))
        return out


class EncoderLayer(FeedForward):
    """Self-attention and feed-forward layers."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__(config)
        self.self_attn = Attention(config.dim_model, config.n_heads)

    def forward(self, x: Tensor, position: Tensor) -> Tensor:
        """[B, L, D]; positions go to queries and keys alone."""
        own = self.before(x, self.norm1)
        at = own + position
        x = self.after(x, self.self_attn(at, at, own), self.norm1)
        return self.after(x, self.feed_forward(self.before(x, self.norm2)), self.norm2)


class DecoderLayer(FeedForward):
    """Self-attention, attention to the encoder's tokens, and feed-forward layers."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__(config)
        self.norm3 = nn.LayerNorm(config.dim_model)
        self.self_attn = Attention(config.dim_model, config.n_heads)
        self.multihead_attn = Attention(config.dim_model, config.n_heads)

    def forward(
        self, x: Tensor, position: Tensor, tokens: Tensor, token_position: Tensor
    ) -> Tensor:
        """Actions [B, L, D] and tokens [B, M, D], each with its positions."""
        own = self.before(x, self.norm1)
        at = own + position
        x = self.after(x, self.self_attn(at, at, own), self.norm1)
        query = self.before(x, self.norm2) + position
        x = self.after(x, self.multihead_attn(query, tokens + token_position, tokens), self.norm2)
        return self.after(x, self.feed_forward(self.before(x, self.norm3)), self.norm3)


class Encoder(nn.Module):
    """The layers, and a norm at their end where norms come first."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(EncoderLayer(config) for _ in range(config.n_encoder_layers))
        self.norm: nn.Module = nn.LayerNorm(config.dim_model) if config.pre_norm else nn.Identity()

    def forward(self, x: Tensor, position: Tensor) -> Tensor:
        """[B, L, D] -> [B, L, D]."""
        for layer in self.layers:
            x = layer(x, position)
        out: Tensor = self.norm(x)
        return out


class Decoder(nn.Module):
    """The layers, and a norm at their end."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        self.layers = nn.ModuleList(DecoderLayer(config) for _ in range(config.n_decoder_layers))
        self.norm = nn.LayerNorm(config.dim_model)

    def forward(
        self, x: Tensor, position: Tensor, tokens: Tensor, token_position: Tensor
    ) -> Tensor:
        """As ``DecoderLayer.forward``."""
        for layer in self.layers:
            x = layer(x, position, tokens, token_position)
        out: Tensor = self.norm(x)
        return out


class Act(nn.Module):
    """Normalised images and state -> normalised actions.

    The tokens are the latent, the state where there is one, and the cells of each camera's map.
    """

    prefix = "model."
    """Before the names of its parameters in LeRobot's file."""

    def __init__(self, config: ActConfig) -> None:
        super().__init__()
        dim, state_dim = config.dim_model, config.features.state_dim
        self.cameras, self.latent_dim = len(config.features.image_keys), config.latent_dim
        self.backbone = Backbone(config.vision_backbone, group_norm=False)
        self.encoder_img_feat_input_proj = nn.Conv2d(self.backbone.channels, dim, 1)
        self.encoder_latent_input_proj = nn.Linear(config.latent_dim, dim)
        self.encoder_robot_state_input_proj = nn.Linear(state_dim, dim) if state_dim else None
        self.encoder_1d_feature_pos_embed = nn.Embedding(2 if state_dim else 1, dim)
        self.encoder, self.decoder = Encoder(config), Decoder(config)
        self.decoder_pos_embed = nn.Embedding(config.chunk_size, dim)
        self.action_head = nn.Linear(dim, ACTION_DIM)
        cells = map_size(config.features.image_height, config.features.image_width)
        self._cell_position: Tensor
        self.register_buffer("_cell_position", cell_positions(*cells, dim), persistent=False)

    @staticmethod
    def own_name(name: str) -> str | None:
        """Our name of a parameter in LeRobot's file, without the prefix; None: not needed."""
        return None if name.startswith("vae_encoder") else name

    def encode(self, image: Tensor, _camera: int) -> Tensor:
        """[B, 3, H, W] -> cells [B, D * h * w], of any camera."""
        cells: Tensor = self.encoder_img_feat_input_proj(self.backbone(image)).flatten(1)
        return cells

    def act(self, feature: Tensor, state: Tensor, _num_diffusion_steps: int) -> Tensor:
        """Features [B, 1, cameras, F] and state [B, 1, S] -> actions [B, chunk_size, 4]."""
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
        actions: Tensor = self.action_head(self.decoder(start, of_actions, encoded, position))
        return actions


def cell_positions(height: int, width: int, dim: int) -> Tensor:
    """Fixed positions of the cells of a map [height * width, dim]: rows, then columns.

    Sine and cosine by turns, of the row or column from 1 on as a share of 2 pi (DETR, Carion et al.
    2020). Computed in float32, as in LeRobot.
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
