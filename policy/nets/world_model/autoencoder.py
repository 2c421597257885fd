"""Per-frame autoencoder: pixels to a few latent channels at an eighth of the side, and back."""

from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn

MAX_LOG_VARIANCE = 4.0
_RESIDUAL_GAIN = 0.3
_INITIAL_LOG_VARIANCE = -4.0
"""At 0, the noise would drown the weak signal of a new encoder's latents."""


class ResidualConv(nn.Module):
    """Two convolutions around a shortcut; [N, C, h, w] -> same shape."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Add a residual. No norm: a network this shallow needs none, and it would cost time."""
        out: Tensor = x + self.conv2(F.silu(self.conv1(F.silu(x))))
        return out


class FrameAutoencoder(nn.Module):
    """Encoder and decoder of single frames; latents are normalised to unit scale per channel.

    ``widths`` belong to the levels at a half, a quarter and an eighth of the side. Only a pixel
    shuffle works at full resolution: a convolution there would cost more than all the others.
    """

    def __init__(self, latent_channels: int, widths: tuple[int, int, int]) -> None:
        super().__init__()
        first, last = widths[0], widths[-1]
        down: list[nn.Module] = [nn.Conv2d(3, first, 3, stride=2, padding=1), ResidualConv(first)]
        for width, deeper in pairwise(widths):
            down += [nn.Conv2d(width, deeper, 3, stride=2, padding=1), ResidualConv(deeper)]
        self.encoder = nn.Sequential(*down, nn.SiLU())
        self.moments = nn.Conv2d(last, 2 * latent_channels, 1)
        up: list[nn.Module] = [nn.Conv2d(latent_channels, last, 3, padding=1), ResidualConv(last)]
        for width, shallower in pairwise(reversed(widths)):
            up += [nn.Conv2d(width, 4 * shallower, 3, padding=1), nn.PixelShuffle(2)]
            up += [ResidualConv(shallower)]
        out = nn.Conv2d(first, 4 * 3, 3, padding=1)
        self.decoder = nn.Sequential(*up, nn.SiLU(), out, nn.PixelShuffle(2))
        self._initialise(out)
        self.latent_mean = nn.Buffer(torch.zeros(latent_channels))
        self.latent_std = nn.Buffer(torch.ones(latent_channels))

    def _initialise(self, out: nn.Conv2d) -> None:
        """Apply He initialisation and small residuals.

        With torch's default, signals halve from layer to layer, and learning is slower.
        """
        for module in self.modules():
            if isinstance(module, nn.Conv2d):
                nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
                nn.init.zeros_(module.bias)  # type: ignore[arg-type]
        residuals = [m.conv2 for m in self.modules() if isinstance(m, ResidualConv)]
        for conv in (*residuals, out):
            conv.weight.data.mul_(_RESIDUAL_GAIN)
        _, log_variance = self.moments.bias.data.chunk(2)  # type: ignore[union-attr]
        log_variance.fill_(_INITIAL_LOG_VARIANCE)

    def posterior(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Return mean and log variance [N, C, h, w], raw, for images [N, 3, H, W] in [-1, 1]."""
        mean, log_variance = self.moments(self.encoder(images)).chunk(2, dim=1)
        return mean, log_variance.clamp(-20.0, MAX_LOG_VARIANCE)

    def reconstruct(self, latents: Tensor) -> Tensor:
        """Decode raw latents [N, C, h, w] -> [N, 3, H, W], about [-1, 1]."""
        images: Tensor = self.decoder(latents)
        return images

    def normalise(self, latents: Tensor) -> Tensor:
        """Scale raw latents [N, C, h, w] to unit scale."""
        return (latents - _per_channel(self.latent_mean)) / _per_channel(self.latent_std)

    def denormalise(self, latents: Tensor) -> Tensor:
        """Undo ``normalise``."""
        return latents * _per_channel(self.latent_std) + _per_channel(self.latent_mean)


def to_unit(images: Tensor) -> Tensor:
    """Convert [N, H, W, 3] uint8 to [N, 3, H, W] float in [-1, 1], channels-last memory."""
    return images.permute(0, 3, 1, 2).float() / 127.5 - 1.0


def to_bytes(images: Tensor) -> Tensor:
    """Convert [N, 3, H, W], about [-1, 1], to [N, H, W, 3] uint8."""
    scaled = ((images + 1.0) * 127.5).round().clamp(0.0, 255.0)
    return scaled.to(torch.uint8).permute(0, 2, 3, 1).contiguous()


def _per_channel(values: Tensor) -> Tensor:
    return values.view(1, -1, 1, 1)
