"""A world painted on the sky, and a camera that turns in it, to check the model's frame warp."""

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from helpers.factories import make_state
from mavbridge.core.records import ImageArray
from policy import rotation
from policy.contract import QUATERNION
from sitl.vehicle.rotation import from_euler

Array = NDArray[np.float64]
FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
NEAREST = 1e-3
"""Depth limit of a unit ray: points beside or behind the camera project far outside the image."""
FOV_RAD, TILT_RAD = math.radians(90.0), math.radians(10.0)


@dataclass(frozen=True)
class PinholeCamera:
    """Camera fixed to the body; its images are squares, and its pixel centres are integers.

    Camera axes: x right, y down, z along the optical axis.
    """

    size: int

    @property
    def focal_px(self) -> float:
        return self.size / 2 / math.tan(FOV_RAD / 2)

    @property
    def frd_from_camera(self) -> Array:
        sine, cosine = math.sin(TILT_RAD), math.cos(TILT_RAD)
        return np.array([[0.0, sine, cosine], [1.0, 0.0, 0.0], [0.0, cosine, -sine]])

    def rays(self) -> Array:
        """Return rays [size, size, 3] in camera axes, of unit depth."""
        across = (np.arange(self.size) - (self.size - 1) / 2) / self.focal_px
        x, y = np.meshgrid(across, across)
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def look_up(self, image: ImageArray, rays: Array) -> tuple[ImageArray, NDArray[np.bool_]]:
        """Return an image's colours in directions [H, W, 3], and the mask of those inside it."""
        depth = np.maximum(rays[..., 2], NEAREST)
        last = self.size - 1
        u, v = (self.focal_px * rays[..., axis] / depth + last / 2 for axis in (0, 1))
        is_inside = (u >= 0) & (u <= last) & (v >= 0) & (v <= last) & (rays[..., 2] > NEAREST)
        seen = cv2.remap(
            image,
            np.clip(u, -1, self.size).astype(np.float32),
            np.clip(v, -1, self.size).astype(np.float32),
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return seen.astype(image.dtype, copy=False), is_inside

    def turned(
        self, image: ImageArray, ned_from_before: Array, ned_from_after: Array
    ) -> ImageArray:
        """Return the image after the turn between two attitudes [3, 3], if all things are far."""
        axes = self.frd_from_camera
        before_from_after = axes.T @ ned_from_before.T @ ned_from_after @ axes
        return self.look_up(image, self.rays() @ before_from_after.T)[0]


def nominal_lens(size: int) -> PinholeCamera:
    return PinholeCamera(size)


def state_of(roll_rad: float, pitch_rad: float, yaw_rad: float) -> NDArray[np.float32]:
    """Return a state [13] with this attitude."""
    state = make_state().values.copy()
    quaternion = np.array(from_euler(roll_rad, pitch_rad, yaw_rad))
    state[QUATERNION] = quaternion if quaternion[0] >= 0 else -quaternion
    return state


def attitude(roll_rad: float = 0.0, pitch_rad: float = 0.0, yaw_rad: float = 0.0) -> Array:
    """Return the rotation [3, 3] from FRD to NED."""
    quaternion = state_of(roll_rad, pitch_rad, yaw_rad)[QUATERNION].astype(np.float64)
    return rotation.rotate(quaternion, np.eye(3)).T


def panorama(lens: PinholeCamera, ned_from_frd: Array) -> ImageArray:
    """Return the view: smooth colours of all directions, infinitely far away."""
    ned = lens.rays() @ (ned_from_frd @ lens.frd_from_camera).T
    ned /= np.linalg.norm(ned, axis=-1, keepdims=True)
    waves = np.random.default_rng(0).normal(size=(3, 12, 3))
    phases = np.random.default_rng(1).uniform(0, 2 * np.pi, (3, 12))
    colours = [np.sin(ned @ (5.0 * waves[c]).T + phases[c]).sum(axis=-1) for c in range(3)]
    return np.clip(128 + 25 * np.stack(colours, axis=-1), 0, 255).round().astype(np.uint8)
