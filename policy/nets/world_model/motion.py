"""Future states relative to now, and the newest frame seen from there.

States change in the vehicle's current body axes. So a prediction is independent of the heading and
of the state frame, it is continuous in every attitude, and no network has to learn quaternions.

A pixel of a later frame looks along a ray. Turned into the current camera's axes, the ray points at
the same object in the newest frame if the object is far away; translation shifts it by the object's
inverse depth. A small network that learns from photometric error alone gives the inverse depth
(T. Zhou et al. 2017, "Unsupervised Learning of Depth and Ego-Motion from Video").
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import QUATERNION, RATE, SPECIFIC_FORCE, VELOCITY, Contract, StateFrame
from policy.motion.rotation import matrix_columns
from policy.nets.world_model.config import WorldModelConfig
from policy.preprocess import egocentric_columns, egocentric_scale

MOTION_DIM = 15
"""Change of velocity [3] m/s in the current body axes, first two columns of the rotation from the
other to the current axes minus those of the identity [6], change of body rates [3] rad/s and of
specific force [3] m/s^2."""
_ROTATION = slice(3, 9)

MOTION_SCALE = (
    *(1.0, 1.0, 1.0),  # m/s: a second of a brisk manoeuvre
    *(0.3, 0.3, 0.3, 0.3, 0.3, 0.3),  # sines of angles
    *(1.0, 1.0, 1.0),  # rad/s
    *(3.0, 3.0, 3.0),  # m/s^2
)
"""Divisors of past motions in a network's input."""
DEPTH_WIDTH = 32
FINER = 2
"""Resolution of the inverse depth relative to the latents'."""
_INITIAL_INVERSE_DEPTH = -3.0
"""Before softplus: a new network places everything 20 m away."""
_INITIAL_STD = 0.02
_MIN_DEPTH = 1e-3
"""Along a ray of about unit length: points beside or behind the camera land far outside."""


def motion_since(now: Tensor, then: Tensor) -> Tensor:
    """Return motions [..., 15] from ``now`` to other states, earlier or later.

    Both are [..., 13] in SI units and one frame, and are broadcast.
    """
    to_body = _matrix(now[..., QUATERNION]).transpose(-1, -2)
    change = then - now
    velocity = (to_body @ change[..., VELOCITY, None]).squeeze(-1)
    turned = to_body @ _matrix(then[..., QUATERNION])
    columns = (turned - torch.eye(3, dtype=now.dtype, device=now.device))[..., :2]
    rotation = columns.transpose(-1, -2).flatten(-2)
    return torch.cat([velocity, rotation, change[..., RATE], change[..., SPECIFIC_FORCE]], dim=-1)


def state_after(now: Tensor, motion: Tensor) -> Tensor:
    """Apply motions [..., 15] to ``now`` [..., 13]: states [..., 13]; inverts ``motion_since``.

    The quaternion is normalised with w >= 0, for any six numbers of the rotation.
    """
    to_world = _matrix(now[..., QUATERNION])
    velocity = now[..., VELOCITY] + (to_world @ motion[..., VELOCITY, None]).squeeze(-1)
    quaternion = _quaternion(to_world @ _orthonormal(motion[..., _ROTATION]))
    rates = now[..., RATE] + motion[..., 9:12]
    force = now[..., SPECIFIC_FORCE] + motion[..., 12:15]
    return torch.cat([velocity, quaternion, rates, force], dim=-1)


@dataclass(frozen=True, kw_only=True)
class Poses:
    """Poses of the vehicle at N moments, in its current body axes."""

    rotation: Tensor
    """[B, N, 3, 3], from the body axes at each moment to the current ones."""
    position_m: Tensor
    """[B, N, 3]"""
    progress: Tensor
    """[B, N] fraction of the time from now to the end of the future."""

    def at(self, moments: Tensor) -> "Poses":
        """Return the poses with indices [B, n]."""
        row = torch.arange(len(moments), device=moments.device)[:, None]
        return Poses(**{name: value[row, moments] for name, value in vars(self).items()})


def poses_after(now: Tensor, motion: Tensor, dt_s: float) -> Poses:
    """Integrate motions [B, T, 15], ``dt_s`` apart, from ``now`` [B, 13] in SI units."""
    to_body = _matrix(now[:, QUATERNION]).transpose(-1, -2)
    start_mps = (to_body @ now[:, VELOCITY, None]).transpose(-1, -2)
    ends_mps = start_mps + motion[..., VELOCITY]
    begins_mps = torch.cat([start_mps, ends_mps[:, :-1]], dim=1)
    position_m = dt_s * (0.5 * (begins_mps + ends_mps)).cumsum(dim=1)
    progress = torch.arange(1, motion.shape[1] + 1, device=now.device) / motion.shape[1]
    return Poses(
        rotation=_orthonormal(motion[..., _ROTATION]),
        position_m=position_m,
        progress=progress.expand(len(now), -1),
    )


def vertical_in_body(states: Tensor) -> Tensor:
    """Return the third axis of the world [..., 3] in body axes, for states [..., 13]."""
    return _matrix(states[..., QUATERNION])[..., 2, :]


def features_dim(context_frames: int) -> int:
    """Width of ``context_features``."""
    return 12 + MOTION_DIM * (context_frames - 1)


def context_features(states: Tensor, contract: Contract) -> Tensor:
    """Return features [B, features_dim(K)] of about 1 for states [B, K, 13], oldest first.

    They are the newest state as ``StateEncoder`` takes it, then the motions back to the older ones.
    """
    now = states[:, -1:]
    scale = now.new_tensor(egocentric_scale(contract)[:12])
    ego = torch.stack(egocentric_columns(now[:, 0].unbind(-1)), dim=-1) / scale
    back = motion_since(now, states[:, :-1]) / now.new_tensor(MOTION_SCALE)
    return torch.cat([ego, back.flatten(1)], dim=1)


def _matrix(quaternion: Tensor) -> Tensor:
    """Convert unit quaternions [..., 4], w first, to rotation matrices [..., 3, 3]."""
    columns = matrix_columns(*quaternion.unbind(-1))
    return torch.stack([torch.stack(column, dim=-1) for column in columns], dim=-1)


def _orthonormal(rotation: Tensor) -> Tensor:
    """Return the rotation [..., 3, 3] nearest to two columns minus the identity's [..., 6]."""
    identity = rotation.new_tensor((1.0, 0.0, 0.0, 0.0, 1.0, 0.0))
    first, second = (rotation + identity).chunk(2, dim=-1)
    first = F.normalize(first, dim=-1)
    second = F.normalize(second - (first * second).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def _quaternion(matrix: Tensor) -> Tensor:
    """Convert rotation matrices [..., 3, 3] to unit quaternions [..., 4] with w >= 0.

    Row i of the outer product below is the quaternion times four times its component i: the row of
    the largest component is the most exact.
    """
    xx, yy, zz = matrix.diagonal(dim1=-2, dim2=-1).unbind(-1)
    lower = matrix[..., (2, 0, 1), (1, 2, 0)]
    upper = matrix[..., (1, 2, 0), (2, 0, 1)]
    wx, wy, wz = (lower - upper).unbind(-1)
    yz, xz, xy = (lower + upper).unbind(-1)
    ww, ii = 1 + xx + yy + zz, 1 + xx - yy - zz
    jj, kk = 1 - xx + yy - zz, 1 - xx - yy + zz
    rows = [(ww, wx, wy, wz), (wx, ii, xy, xz), (wy, xy, jj, yz), (wz, xz, yz, kk)]
    outer = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    largest = largest[..., None, None].expand(*matrix.shape[:-2], 1, 4)
    chosen = F.normalize(outer.gather(-2, largest).squeeze(-2), dim=-1)
    return torch.where(chosen[..., :1] < 0, -chosen, chosen)


@dataclass(frozen=True, kw_only=True)
class SourceFrame:
    """Newest frame, ready to be warped."""

    pixels: Tensor
    """[B, 3, H, W], about [-1, 1]."""
    inverse_depth: Tensor
    """[B, 2, FINER h, FINER w] before softplus, 1/m: the current value, and its increase until the
    end of the future."""


class FrameWarp(nn.Module):
    """Warps square frames of a forward-looking pinhole camera without distortion.

    Camera axes: x right, y down, z along the optical axis.
    """

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        state_frame = config.contract.state_frame
        self._half_width = math.tan(config.horizontal_fov_rad / 2)
        self._down_sign = 1.0 if state_frame == "ned_frd" else -1.0
        last = nn.Conv2d(DEPTH_WIDTH, 2 * FINER**2, 3, padding=1)
        nn.init.normal_(last.weight, std=_INITIAL_STD)
        with torch.no_grad():
            bias = torch.tensor([_INITIAL_INVERSE_DEPTH] * FINER**2 + [0.0] * FINER**2)
            last.bias.copy_(bias)  # type: ignore[union-attr]
        self.inverse_depth = nn.Sequential(
            nn.Conv2d(config.latent_channels + 1, DEPTH_WIDTH, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(DEPTH_WIDTH, DEPTH_WIDTH, 3, padding=1),
            nn.SiLU(),
            last,
            nn.PixelShuffle(FINER),
        )
        axes = _body_from_camera(config.camera_tilt_rad, state_frame)
        self._rays = nn.Buffer(self._unit_rays(config.image_size), persistent=False)
        cells = self._unit_rays(config.latent_shape[-1]) @ axes.T
        self._cell_rays_body = nn.Buffer(cells, persistent=False)
        self._body_from_camera = nn.Buffer(axes, persistent=False)

    def source(self, pixels: Tensor, latents: Tensor, vertical_body: Tensor) -> SourceFrame:
        """Estimate the inverse depth of a frame from its pixels and its latents [B, C, h, w].

        ``vertical_body`` [B, 3] is the third axis of the world, in body axes.
        """
        # The steeper a ray points down, the nearer is level ground; only the height is unknown.
        below = (self._cell_rays_body @ (self._down_sign * vertical_body)[:, None, :, None])[..., 0]
        inputs = torch.cat([latents, below.clamp_min(0.0)[:, None]], dim=1)
        return SourceFrame(pixels=pixels, inverse_depth=self.inverse_depth(inputs))

    def warp(self, source: SourceFrame, poses: Poses) -> tuple[Tensor, Tensor]:
        """Return frames [B, N, 3, H, W] seen from other poses, and the pixels in view [B, N, H, W].

        A pixel out of view shows the nearest one of the border.
        """
        axes = self._body_from_camera
        turn = axes.T @ poses.rotation @ axes
        translation_m = (poses.position_m @ axes)[:, :, None, None]
        rays = self._rays.flatten(0, 1) @ turn.transpose(-1, -2)
        rays = rays.reshape(*turn.shape[:2], *self._rays.shape)
        far = rays / rays[..., 2:].clamp_min(_MIN_DEPTH)
        now, growth = self._sampled(source.inverse_depth, far).unbind(dim=2)
        inverse_depth_per_m = F.softplus(now + growth * poses.progress[:, :, None, None])
        seen = far + translation_m * inverse_depth_per_m[..., None]
        is_ahead = (rays[..., 2] > _MIN_DEPTH) & (seen[..., 2] > _MIN_DEPTH)
        is_inside = (self._on_image(seen).abs() <= 1.0).all(dim=-1)
        return self._sampled(source.pixels, seen), is_ahead & is_inside

    def _sampled(self, image: Tensor, rays: Tensor) -> Tensor:
        """Sample images [B, C, ., .] along rays [B, N, H, W, 3] -> [B, N, C, H, W]."""
        places = self._on_image(rays)
        seen = F.grid_sample(
            image, places.flatten(1, 2), padding_mode="border", align_corners=False
        )
        batch, channels, _, width = seen.shape
        return seen.reshape(batch, channels, rays.shape[1], -1, width).transpose(1, 2)

    def _on_image(self, rays: Tensor) -> Tensor:
        """Project rays [..., 3] to image positions [..., 2], -1 to 1 from border to border."""
        return rays[..., :2] / (self._half_width * rays[..., 2:].clamp_min(_MIN_DEPTH))

    def _unit_rays(self, side: int) -> Tensor:
        """Return rays [side, side, 3] of unit depth through pixel centres."""
        at = self._half_width * ((2 * torch.arange(side) + 1) / side - 1)
        y, x = torch.meshgrid(at, at, indexing="ij")
        return torch.stack([x, y, torch.ones_like(x)], dim=-1)


def _body_from_camera(tilt_rad: float, state_frame: StateFrame) -> Tensor:
    """Return the rotation [3, 3] from camera to body axes, FRD or FLU as in the states."""
    sine, cosine = math.sin(tilt_rad), math.cos(tilt_rad)
    frd = torch.tensor([[0.0, sine, cosine], [1.0, 0.0, 0.0], [0.0, cosine, -sine]])
    return frd if state_frame == "ned_frd" else frd * torch.tensor([[1.0], [-1.0], [-1.0]])
