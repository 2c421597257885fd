"""The newest frame as it will look from where the vehicle will be: what no net has to paint.

A pixel of a later frame looks along a ray. Turned into the camera of now, that ray says where the
newest frame shows the same thing, were it far away; how near it is says how much the way that was
flown moves it. Rotation and way come from a motion that is foreseen, nearness from a small net that
learns from nothing but pictures that ought to match (T. Zhou et al. 2017).
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import StateFrame

NEARNESS_WIDTH = 32
FINER = 2
"""Nearness is told at so many times the resolution of the latents."""
_FIRST_NEARNESS = -3.0
"""Before softplus: a new net takes all things to be 20 m away."""
_SMALL = 0.02
_LEAST_DEPTH = 1e-3
"""Of a ray of about unit length: what is beside or behind the camera ends far outside its view."""


@dataclass(frozen=True, kw_only=True)
class View:
    """The newest frame."""

    pixels: Tensor
    """[B, 3, H, W] about [-1, 1]"""
    nearness: Tensor
    """[B, 2, FINER h, FINER w] before softplus: now, and by how much it grows until the end."""


@dataclass(frozen=True, kw_only=True)
class Poses:
    """Where the vehicle will be at N moments, in its body axes of now."""

    rotation: Tensor
    """[B, N, 3, 3] to the axes of now from those of then."""
    position_m: Tensor
    """[B, N, 3]"""
    progress: Tensor
    """[B, N] of the time from now to the end of the future, 0 to 1."""

    def of(self, moments: Tensor) -> "Poses":
        """Those with numbers [B, n]."""
        row = torch.arange(len(moments), device=moments.device)[:, None]
        return Poses(**{name: value[row, moments] for name, value in vars(self).items()})


class CarriedView(nn.Module):
    """Moves frames; a pinhole camera without distortion that looks ahead, its images squares.

    Camera axes: x right, y down, z along the optical axis.
    """

    def __init__(
        self,
        *,
        latent_channels: int,
        latent_side: int,
        image_size: int,
        horizontal_fov_rad: float,
        camera_tilt_rad: float,
        state_frame: StateFrame,
    ) -> None:
        super().__init__()
        self._half_width = math.tan(horizontal_fov_rad / 2)
        self._down_sign = 1.0 if state_frame == "ned_frd" else -1.0
        width = NEARNESS_WIDTH
        last = nn.Conv2d(width, 2 * FINER**2, 3, padding=1)
        nn.init.normal_(last.weight, std=_SMALL)
        with torch.no_grad():
            last.bias.copy_(torch.tensor([_FIRST_NEARNESS] * FINER**2 + [0.0] * FINER**2))  # type: ignore[union-attr]
        self.nearness = nn.Sequential(
            nn.Conv2d(latent_channels + 1, width, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(width, width, 3, padding=1),
            nn.SiLU(),
            last,
            nn.PixelShuffle(FINER),
        )
        axes = _body_from_camera(camera_tilt_rad, state_frame)
        self._rays: Tensor
        self._cell_rays_body: Tensor
        self._body_from_camera: Tensor
        self.register_buffer("_rays", self._unit_rays(image_size), persistent=False)
        cells = self._unit_rays(latent_side) @ axes.T
        self.register_buffer("_cell_rays_body", cells, persistent=False)
        self.register_buffer("_body_from_camera", axes, persistent=False)

    def view(self, pixels: Tensor, latents: Tensor, vertical_body: Tensor) -> View:
        """The newest frame, and how near things in it are.

        Args:
            pixels: [B, 3, H, W] about [-1, 1].
            latents: [B, C, h, w] of the same.
            vertical_body: [B, 3] the third axis of the world, in body axes.
        """
        # Level ground is the nearer the steeper a ray goes down: only its distance is to be found.
        below = (self._cell_rays_body @ (self._down_sign * vertical_body)[:, None, :, None])[..., 0]
        nearness = self.nearness(torch.cat([latents, below.clamp_min(0.0)[:, None]], dim=1))
        return View(pixels=pixels, nearness=nearness)

    def moved(self, view: View, poses: Poses) -> tuple[Tensor, Tensor]:
        """Frames [B, N, 3, H, W] from other poses, and what of them was in view [B, N, H, W].

        Elsewhere the nearest pixel of the border stands in.
        """
        axes = self._body_from_camera
        turn = axes.T @ poses.rotation @ axes
        way_m = (poses.position_m @ axes)[:, :, None, None]
        rays = self._rays.flatten(0, 1) @ turn.transpose(-1, -2)
        rays = rays.reshape(*turn.shape[:2], *self._rays.shape)
        far = rays / rays[..., 2:].clamp_min(_LEAST_DEPTH)
        now, growth = self._sampled(view.nearness, far).unbind(dim=2)
        nearness_per_m = F.softplus(now + growth * poses.progress[:, :, None, None])
        seen = far + way_m * nearness_per_m[..., None]
        is_ahead = (rays[..., 2] > _LEAST_DEPTH) & (seen[..., 2] > _LEAST_DEPTH)
        is_inside = (self._on_image(seen).abs() <= 1.0).all(dim=-1)
        return self._sampled(view.pixels, seen), is_ahead & is_inside

    def _sampled(self, image: Tensor, rays: Tensor) -> Tensor:
        """What images [B, C, ., .] show along rays [B, N, H, W, 3]: [B, N, C, H, W]."""
        places = self._on_image(rays)
        seen = F.grid_sample(
            image, places.flatten(1, 2), padding_mode="border", align_corners=False
        )
        batch, channels, _, width = seen.shape
        return seen.reshape(batch, channels, rays.shape[1], -1, width).transpose(1, 2)

    def _on_image(self, rays: Tensor) -> Tensor:
        """Rays [..., 3] -> places [..., 2], -1 to 1 from border to border."""
        return rays[..., :2] / (self._half_width * rays[..., 2:].clamp_min(_LEAST_DEPTH))

    def _unit_rays(self, side: int) -> Tensor:
        """[side, side, 3] through the middles of pixels, of unit depth."""
        at = self._half_width * ((2 * torch.arange(side) + 1) / side - 1)
        y, x = torch.meshgrid(at, at, indexing="ij")
        return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def _body_from_camera(tilt_rad: float, state_frame: StateFrame) -> Tensor:
    """[3, 3]; body axes are FRD or FLU, as the states'."""
    sine, cosine = math.sin(tilt_rad), math.cos(tilt_rad)
    frd = torch.tensor([[0.0, sine, cosine], [1.0, 0.0, 0.0], [0.0, cosine, -sine]])
    return frd if state_frame == "ned_frd" else frd * torch.tensor([[1.0], [-1.0], [-1.0]])
