"""Future states relative to now: changes in the vehicle's current body axes.

So a prediction is independent of the heading and of the state frame, it is continuous in every
attitude, and no network has to learn quaternions.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from policy.contract import QUATERNION, RATE, SPECIFIC_FORCE, VELOCITY, Contract
from policy.preprocess import egocentric_columns, egocentric_scale
from policy.rotation import matrix_columns

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


def poses_after(now: Tensor, motion: Tensor, dt_s: float) -> tuple[Tensor, Tensor]:
    """Integrate motions [B, T, 15], ``dt_s`` apart, from ``now`` [B, 13] in SI units.

    Returns:
        Rotations [B, T, 3, 3] from the later to the current axes, and positions [B, T, 3] in m,
            both in the current body axes.
    """
    to_body = _matrix(now[:, QUATERNION]).transpose(-1, -2)
    start_mps = (to_body @ now[:, VELOCITY, None]).transpose(-1, -2)
    ends_mps = start_mps + motion[..., VELOCITY]
    begins_mps = torch.cat([start_mps, ends_mps[:, :-1]], dim=1)
    position_m = dt_s * (0.5 * (begins_mps + ends_mps)).cumsum(dim=1)
    return _orthonormal(motion[..., _ROTATION]), position_m


def vertical_in_body(states: Tensor) -> Tensor:
    """Return the third axis of the world [..., 3] in body axes, for states [..., 13]."""
    return _matrix(states[..., QUATERNION])[..., 2, :]


def features_dim(context_frames: int) -> int:
    """Width of ``context_features``."""
    return 12 + MOTION_DIM * (context_frames - 1)


def context_features(states: Tensor, contract: Contract) -> Tensor:
    """Return features [B, features_dim(K)] of about 1 for states [B, K, 13], oldest first.

    They are the newest state by ``preprocess.egocentric``, then the motions back to the older ones.
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
