"""The denoiser: a 1-D U-Net over the actions of a chunk, conditioned by FiLM.

FiLM (Perez et al. 2018) scales and shifts the channels of every residual block. Here the parameters
of all blocks are one vector, and it is a sum of two independent parts:

    film = film_of_timestep(t) + film_of_condition(c)            [B, film_dim]

So the condition's part is computed once for a whole solve, the timestep's part is a constant of the
weights and the number of steps, and an engine can fold it and fuse the rest into one product.
"""

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import ACTION_DIM
from policy.errors import PolicyError
from policy.nets.attention import is_tracing

GROUPS = 8
TAPS = 5
TIME_DIM = 128


class Conv(nn.Module):
    """Convolution over a short sequence as one matrix product; [B, C_in, L] -> [B, C_out, L'].

    Computes ``nn.Conv1d`` with padding ``taps // 2``, its weight laid out as [C_out, taps * C_in].
    Over at most 16 positions a convolution is bound by reading its weights, and torch's CPU kernels
    read them up to 4 times slower than its matrix product. OpenVINO is faster at convolutions.
    """

    def __init__(self, channels_in: int, channels_out: int, taps: int, *, stride: int = 1) -> None:
        super().__init__()
        self.taps, self.stride = taps, stride
        self.linear = nn.Linear(taps * channels_in, channels_out)

    def forward(self, x: Tensor) -> Tensor:
        """Concatenate the taps, then multiply by the weight."""
        pad, linear = self.taps // 2, self.linear
        if is_tracing():
            weight = linear.weight.view(linear.out_features, self.taps, -1)
            weight = weight.transpose(1, 2).unsqueeze(2)
            padding, stride = (0, pad), (1, self.stride)
            return F.conv2d(x.unsqueeze(2), weight, linear.bias, stride, padding).squeeze(2)
        length, padded = x.shape[2], F.pad(x, (pad, pad))
        columns = [padded[..., tap : tap + length : self.stride] for tap in range(self.taps)]
        out: Tensor = linear(torch.cat(columns, dim=1).transpose(1, 2)).transpose(1, 2)
        return out


class Pointwise(nn.Linear):
    """Linear layer at every position; [B, C_in, L] -> [B, C_out, L]."""

    def forward(self, x: Tensor) -> Tensor:
        """Apply the layer."""
        if is_tracing():
            weight = self.weight[:, :, None, None]
            return F.conv2d(x.unsqueeze(2), weight, self.bias).squeeze(2)
        return super().forward(x.transpose(1, 2)).transpose(1, 2)


class GroupNorm(nn.GroupNorm):
    """Group norm as a layer norm of each group.

    OpenVINO's CPU plugin splits a group norm into slower parts, and version 2026.4 crashes with a
    segmentation fault when it compiles a ResNet-18 with group norms in float32.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Normalise [B, C, ...]; the shape stays."""
        groups = x.reshape(x.shape[0], self.num_groups, -1)
        normed = F.layer_norm(groups, [int(groups.shape[-1])], eps=self.eps).reshape(x.shape)
        channels = [-1, *[1] * (x.ndim - 2)]
        return normed * self.weight.reshape(channels) + self.bias.reshape(channels)


class ResidualBlock(nn.Module):
    """Two convolutions with FiLM between them, around a shortcut; [B, C_in, L] -> [B, C_out, L]."""

    def __init__(self, channels_in: int, channels_out: int) -> None:
        super().__init__()
        self.conv1 = Conv(channels_in, channels_out, TAPS)
        self.norm1 = GroupNorm(GROUPS, channels_out)
        self.conv2 = Conv(channels_out, channels_out, TAPS)
        self.norm2 = GroupNorm(GROUPS, channels_out)
        self.shortcut: nn.Module = nn.Identity()
        if channels_in != channels_out:
            self.shortcut = Pointwise(channels_in, channels_out)

    def forward(self, x: Tensor, film: Tensor) -> Tensor:
        """Apply the block; ``film`` [B, 2 * C_out] holds scale (about 1) and shift."""
        scale, shift = film.unsqueeze(2).chunk(2, dim=1)
        hidden = F.silu(self.norm1(self.conv1(x)))
        hidden = hidden * (1 + scale) + shift
        hidden = F.silu(self.norm2(self.conv2(hidden)))
        out: Tensor = hidden + self.shortcut(x)
        return out


class UNet1d(nn.Module):
    """Denoiser over [B, horizon, 4].

    ``widths`` are the channels of each level, multiples of 8; the length halves from one level to
    the next.
    """

    def __init__(self, *, horizon: int, condition_dim: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        factor = 2 ** (len(widths) - 1)
        if horizon % factor:
            raise PolicyError(
                f"a horizon of {horizon} does not suit {len(widths)} U-Net levels; "
                f"use a multiple of {factor}"
            )
        self.down, self.downsample = nn.ModuleList(), nn.ModuleList()
        self.up, self.upsample = nn.ModuleList(), nn.ModuleList()
        channels = ACTION_DIM
        for width in widths[:-1]:
            self.down.append(ResidualBlock(channels, width))
            self.downsample.append(Conv(width, width, 3, stride=2))
            channels = width
        self.mid = nn.ModuleList(
            [ResidualBlock(channels, widths[-1]), ResidualBlock(widths[-1], widths[-1])]
        )
        channels = widths[-1]
        for width in reversed(widths[:-1]):
            self.upsample.append(Conv(channels, width, 3))
            self.up.append(ResidualBlock(2 * width, width))
            channels = width
        self.out = Pointwise(channels, ACTION_DIM)
        widths_of_blocks = (*widths[:-1], widths[-1], widths[-1], *reversed(widths[:-1]))
        self.film_sizes = [2 * width for width in widths_of_blocks]
        self.film_dim = sum(self.film_sizes)
        self.time_mlp = nn.Sequential(
            nn.Linear(TIME_DIM, 2 * TIME_DIM),
            nn.SiLU(),
            nn.Linear(2 * TIME_DIM, TIME_DIM),
            nn.SiLU(),
        )
        self.film_time = nn.Linear(TIME_DIM, self.film_dim)
        self.film_condition = nn.Sequential(
            nn.SiLU(), nn.Linear(condition_dim, self.film_dim, bias=False)
        )
        self._frequencies = nn.Buffer(sinusoid_frequencies(TIME_DIM), persistent=False)

    def film_of_timestep(self, timestep: Tensor) -> Tensor:
        """Return the timesteps' part of FiLM [M, film_dim]; timesteps [M] of any numeric type."""
        angle = timestep.to(self._frequencies.dtype).unsqueeze(-1) * self._frequencies
        film: Tensor = self.film_time(self.time_mlp(torch.cat([angle.sin(), angle.cos()], dim=-1)))
        return film

    def film_of_condition(self, condition: Tensor) -> Tensor:
        """Return the condition's part of FiLM [B, film_dim], for a condition [B, C]."""
        film: Tensor = self.film_condition(condition)
        return film

    def forward(self, noisy: Tensor, film: Tensor) -> Tensor:
        """Return the net's prediction for noisy actions [B, horizon, 4] and FiLM [B, film_dim]."""
        films = iter(torch.split(film, self.film_sizes, dim=-1))
        x, skips = noisy.transpose(1, 2), []
        for block, downsample in zip(self.down, self.downsample, strict=True):
            x = block(x, next(films))
            skips.append(x)
            x = downsample(x)
        for block in self.mid:
            x = block(x, next(films))
        for block, upsample in zip(self.up, self.upsample, strict=True):
            x = upsample(F.interpolate(x, scale_factor=2.0))
            x = block(torch.cat([x, skips.pop()], dim=1), next(films))
        out: Tensor = self.out(x)
        return out.transpose(1, 2)


def sinusoid_frequencies(dim: int) -> Tensor:
    """Return geometric frequencies 1..1e-4 of the sinusoidal embedding (Vaswani et al. 2017)."""
    half = dim // 2
    return torch.exp(-math.log(10_000.0) * torch.arange(half) / (half - 1))
