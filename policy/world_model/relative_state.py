"""Future states as the vehicle would tell them: what changed since now, in its body axes of now.

So a prediction is the same on every heading and in both state frames, it is continuous in every
attitude, and no net has to learn what a quaternion is.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from policy.contract import QUATERNION, RATE, SPECIFIC_FORCE, VELOCITY, Contract
from policy.preprocess import egocentric_columns, egocentric_scale

MOTION_DIM = 15
"""Change of velocity [3] m/s in the body axes of now, the first two columns of the rotation from
then to now less those of the identity [6], change of body rates [3] rad/s and of specific force
[3] m/s^2."""
_ROTATION = slice(3, 9)

MOTION_SCALE = (
    *(1.0, 1.0, 1.0),  # m/s: a second of a brisk manoeuvre
    *(0.3, 0.3, 0.3, 0.3, 0.3, 0.3),  # sines of angles
    *(1.0, 1.0, 1.0),  # rad/s
    *(3.0, 3.0, 3.0),  # m/s^2
)
"""What each dimension of a motion is divided by where a net is told of the past."""


def motion_since(now: Tensor, then: Tensor) -> Tensor:
    """States [..., 13] in SI units, earlier or later ones -> their motions [..., 15] from ``now``.

    Args:
        now: [..., 13], broadcast against ``then``.
        then: [..., 13] in the same frame.
    """
    to_world = _matrix(now[..., QUATERNION])
    to_body = to_world.transpose(-1, -2)
    velocity = (to_body @ (then - now)[..., VELOCITY, None]).squeeze(-1)
    turned = to_body @ _matrix(then[..., QUATERNION])
    columns = (turned - torch.eye(3, dtype=now.dtype, device=now.device))[..., :2]
    rotation = columns.transpose(-1, -2).flatten(-2)
    change = then - now
    return torch.cat([velocity, rotation, change[..., RATE], change[..., SPECIFIC_FORCE]], dim=-1)


def state_after(now: Tensor, motion: Tensor) -> Tensor:
    """The inverse: motions [..., 15] from ``now`` [..., 13] -> states [..., 13] in SI units.

    The rotation is made a true one and the quaternion a unit one with w >= 0, whatever a net says.
    """
    to_world = _matrix(now[..., QUATERNION])
    velocity = now[..., VELOCITY] + (to_world @ motion[..., VELOCITY, None]).squeeze(-1)
    quaternion = _quaternion(to_world @ _orthonormal(motion[..., _ROTATION]))
    rates = now[..., RATE] + motion[..., 9:12]
    force = now[..., SPECIFIC_FORCE] + motion[..., 12:15]
    return torch.cat([velocity, quaternion, rates, force], dim=-1)


def poses_after(now: Tensor, motion: Tensor, dt_s: float) -> tuple[Tensor, Tensor]:
    """Where motions [B, T, 15] lead, each ``dt_s`` after the one before, in the body axes of now.

    Args:
        now: [B, 13], SI units; the first motion is ``dt_s`` later.
        motion: from ``now``.
        dt_s: s.

    Returns:
        Rotations [B, T, 3, 3] to the axes of now from those of then, and positions [B, T, 3] in m.
    """
    to_body = _matrix(now[:, QUATERNION]).transpose(-1, -2)
    start_mps = (to_body @ now[:, VELOCITY, None]).transpose(-1, -2)
    ends_mps = start_mps + motion[..., VELOCITY]
    begins_mps = torch.cat([start_mps, ends_mps[:, :-1]], dim=1)
    position_m = dt_s * (0.5 * (begins_mps + ends_mps)).cumsum(dim=1)
    return _orthonormal(motion[..., _ROTATION]), position_m


def vertical_in_body(states: Tensor) -> Tensor:
    """States [..., 13] -> the third axis of their world [..., 3], in body axes."""
    return _matrix(states[..., QUATERNION])[..., 2, :]


def features_dim(context_frames: int) -> int:
    """Of ``context_features``."""
    return 12 + MOTION_DIM * (context_frames - 1)


def context_features(states: Tensor, contract: Contract) -> Tensor:
    """The last states [B, K, 13], oldest first -> what a net is told of them, of size about 1.

    The newest as ``preprocess.egocentric`` makes it, then the motions back to the older ones:
    [B, features_dim(K)].
    """
    now = states[:, -1:]
    scale = now.new_tensor(egocentric_scale(contract)[:12])
    ego = torch.stack(egocentric_columns(now[:, 0].unbind(-1)), dim=-1) / scale
    back = motion_since(now, states[:, :-1]) / now.new_tensor(MOTION_SCALE)
    return torch.cat([ego, back.flatten(1)], dim=1)


def _matrix(quaternion: Tensor) -> Tensor:
    """Unit quaternions [..., 4], w first -> rotation matrices [..., 3, 3]."""
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack(rows, dim=-1).reshape(*w.shape, 3, 3)


def _orthonormal(rotation: Tensor) -> Tensor:
    """Two columns less the identity's [..., 6] -> the nearest such rotation [..., 3, 3]."""
    identity = rotation.new_tensor((1.0, 0.0, 0.0, 0.0, 1.0, 0.0))
    first, second = (rotation + identity).chunk(2, dim=-1)
    first = F.normalize(first, dim=-1)
    second = F.normalize(second - (first * second).sum(-1, keepdim=True) * first, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def _quaternion(matrix: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] -> unit quaternions [..., 4] with w >= 0.

    Of the four ways to write it down, the one that divides by the largest component.
    """
    xx, yy, zz = matrix.diagonal(dim1=-2, dim2=-1).unbind(-1)
    squares = torch.stack([1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz])
    wx, wy, wz = (
        matrix[..., 2, 1] - matrix[..., 1, 2],
        matrix[..., 0, 2] - matrix[..., 2, 0],
        matrix[..., 1, 0] - matrix[..., 0, 1],
    )
    xy, xz, yz = (
        matrix[..., 1, 0] + matrix[..., 0, 1],
        matrix[..., 0, 2] + matrix[..., 2, 0],
        matrix[..., 2, 1] + matrix[..., 1, 2],
    )
    # Row i is the quaternion times four times its component i.
    ww, ii, jj, kk = squares.unbind(0)
    rows = torch.stack(
        [
            torch.stack([ww, wx, wy, wz], dim=-1),
            torch.stack([wx, ii, xy, xz], dim=-1),
            torch.stack([wy, xy, jj, yz], dim=-1),
            torch.stack([wz, xz, yz, kk], dim=-1),
        ],
        dim=-2,
    )
    largest = squares.argmax(dim=0)[..., None, None].expand(*matrix.shape[:-2], 1, 4)
    chosen = F.normalize(rows.gather(-2, largest).squeeze(-2), dim=-1)
    return torch.where(chosen[..., :1] < 0, -chosen, chosen)
