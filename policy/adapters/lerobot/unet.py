"""The denoiser of LeRobot's DiffusionPolicy: a 1-D U-Net over a chunk, conditioned by FiLM.

Parameters have LeRobot's names. Of its FiLM layers, the weights for the timestep and those for the
condition are used apart: what the condition adds is computed once for a whole solve.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.adapters.lerobot.config import DiffusionConfig
from policy.adapters.lerobot.group_norm import GroupNorm
from policy.contract import ACTION_DIM
from policy.nets.unet1d import sinusoid_frequencies


class Mish(nn.Module):
    """Mish (Misra 2019) of vectors, ``x * tanh(softplus(x))``, without that operation.

    With w = exp(x), tanh(softplus(x)) = w (w + 2) / (w (w + 2) + 2). OpenVINO 2026.4 fails to
    compile a Mish between small products of matrices in float32.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Element by element."""
        w = x.clamp(max=20.0).exp()  # above, the quotient is 1
        n = w * (w + 2)
        return x * (n / (n + 2))


class ConvBlock(nn.Module):
    """Convolution, norm, Mish."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int, groups: int) -> None:
        super().__init__()
        self.block = nn.Sequential(
            nn.Conv1d(channels_in, channels_out, kernel, padding=kernel // 2),
            GroupNorm(groups, channels_out),
            nn.Mish(),
        )

    def forward(self, x: Tensor) -> Tensor:
        """[B, C_in, L] -> [B, C_out, L]."""
        out: Tensor = self.block(x)
        return out


class ResidualBlock(nn.Module):
    """Two convolutions with FiLM between them, around a shortcut."""

    def __init__(
        self, channels_in: int, channels_out: int, config: DiffusionConfig, condition_dim: int
    ) -> None:
        super().__init__()
        kernel, groups = config.kernel_size, config.n_groups
        self.scales = config.use_film_scale_modulation
        self.conv1 = ConvBlock(channels_in, channels_out, kernel, groups)
        self.conv2 = ConvBlock(channels_out, channels_out, kernel, groups)
        self.film_dim = channels_out * (2 if self.scales else 1)
        self.cond_encoder = nn.Sequential(Mish(), nn.Linear(condition_dim, self.film_dim))
        self.residual_conv: nn.Module = nn.Identity()
        if channels_in != channels_out:
            self.residual_conv = nn.Conv1d(channels_in, channels_out, 1)

    def forward(self, x: Tensor, film: Tensor) -> Tensor:
        """``film`` [B, film_dim]: scales, where it has any, then shifts."""
        hidden = self.conv1(x)
        if self.scales:
            scale, shift = film.unsqueeze(-1).chunk(2, dim=1)
            hidden = scale * hidden + shift
        else:
            hidden = hidden + film.unsqueeze(-1)
        out: Tensor = self.conv2(hidden) + self.residual_conv(x)
        return out


class UNet(nn.Module):
    """Noisy chunk [B, horizon, 4] -> the net's prediction, by FiLM [B, film_dim]."""

    def __init__(self, config: DiffusionConfig, condition_dim: int) -> None:
        super().__init__()
        widths, self.time_dim = config.down_dims, config.diffusion_step_embed_dim

        def block(channels_in: int, channels_out: int) -> ResidualBlock:
            return ResidualBlock(channels_in, channels_out, config, self.time_dim + condition_dim)

        self.diffusion_step_encoder = nn.Sequential(
            nn.Identity(),  # LeRobot has its sinusoids here, which have no parameters
            nn.Linear(self.time_dim, 4 * self.time_dim),
            Mish(),
            nn.Linear(4 * self.time_dim, self.time_dim),
        )
        # In the order in which they run: ``_film`` counts on it.
        self.down_modules, self.mid_modules = nn.ModuleList(), nn.ModuleList()
        self.up_modules = nn.ModuleList()
        for level, (into, out) in enumerate(zip((ACTION_DIM, *widths), widths, strict=False)):
            last = level == len(widths) - 1
            halve = nn.Identity() if last else nn.Conv1d(out, out, 3, stride=2, padding=1)
            self.down_modules.append(nn.ModuleList([block(into, out), block(out, out), halve]))
        self.mid_modules.extend(block(widths[-1], widths[-1]) for _ in range(2))
        for into, out in zip(widths[:0:-1], widths[-2::-1], strict=True):
            double = nn.ConvTranspose1d(out, out, 4, stride=2, padding=1)
            self.up_modules.append(nn.ModuleList([block(2 * into, out), block(out, out), double]))
        self.final_conv = nn.Sequential(
            # Eight groups whatever config.json says, as in LeRobot.
            ConvBlock(widths[0], widths[0], config.kernel_size, 8),
            nn.Conv1d(widths[0], ACTION_DIM, 1),
        )
        self._frequencies: Tensor
        frequencies = sinusoid_frequencies(self.time_dim)
        self.register_buffer("_frequencies", frequencies, persistent=False)

    def film_of_timestep(self, timestep: Tensor) -> list[Tensor]:
        """What timesteps [B], float32, add to the FiLM of each block, [B, film_dim] of it."""
        angle = timestep.unsqueeze(-1) * self._frequencies
        embedded = self.diffusion_step_encoder(torch.cat([angle.sin(), angle.cos()], dim=-1))
        return self._film(embedded, slice(None, self.time_dim), bias=True)

    def film_of_condition(self, condition: Tensor) -> list[Tensor]:
        """What a condition [B, C] adds to the FiLM of each block, [B, film_dim] of that block."""
        return self._film(condition, slice(self.time_dim, None), bias=False)

    def forward(self, noisy: Tensor, films: list[Tensor]) -> Tensor:
        """``films`` [B, film_dim] of each block, in the order in which they run."""
        x, film, skips = noisy.transpose(1, 2), iter(films), []
        layers: Any = self  # its lists of modules do not say of which class
        for first, second, halve in layers.down_modules:
            x = second(first(x, next(film)), next(film))
            skips.append(x)
            x = halve(x)
        for block in layers.mid_modules:
            x = block(x, next(film))
        for first, second, double in layers.up_modules:
            x = first(torch.cat([x, skips.pop()], dim=1), next(film))
            x = double(second(x, next(film)))
        out: Tensor = self.final_conv(x)
        return out.transpose(1, 2)

    def _film(self, value: Tensor, columns: slice, *, bias: bool) -> list[Tensor]:
        blocks = [module for module in self.modules() if isinstance(module, ResidualBlock)]
        active: Tensor = blocks[0].cond_encoder[0](value)
        linears: list[Any] = [block.cond_encoder[1] for block in blocks]
        return [F.linear(active, m.weight[:, columns], m.bias if bias else None) for m in linears]
