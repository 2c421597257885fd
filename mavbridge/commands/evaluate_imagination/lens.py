"""The camera of a recorded flight: where its pixels look, and what a rotation does to them."""

import math
from dataclasses import dataclass
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mavbridge.core.records import ImageArray
from mavbridge.recording.meta import FlightMeta
from policy import rotation
from policy.contract import QUATERNION, RATE, FloatArray, StateFrame

Array = NDArray[np.float64]
Pixel = TypeVar("Pixel", np.uint8, np.float32)

FRD_FROM_FLU = np.diag([1.0, -1.0, -1.0])
NED_FROM_ENU = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_NEAREST = 1e-3
"""Depth of a unit ray: what is beside or behind the camera ends far outside of the image."""


@dataclass(frozen=True, kw_only=True)
class Mounting:
    """What is assumed of a camera where the flight does not tell; rad."""

    horizontal_fov_rad: float
    tilt_up_rad: float


@dataclass(frozen=True, kw_only=True)
class Lens:
    """A pinhole camera without distortion, fixed to the body; pixel centres are integers.

    Camera axes: x right, y down, z along the optical axis.
    """

    size: int
    """Side of the images, px."""
    focal_px: tuple[float, float]
    """Across and down: they differ where an oblong image was made a square."""
    frd_from_camera: Array
    """[3, 3]"""
    is_recorded: bool
    """The flight told the field of view and the mounting; otherwise they are assumed."""

    def rays(self) -> Array:
        """[size, size, 3] in camera axes, of unit depth."""
        across_px = np.arange(self.size) - (self.size - 1) / 2
        x, y = np.meshgrid(across_px / self.focal_px[0], across_px / self.focal_px[1])
        return np.stack([x, y, np.ones_like(x)], axis=-1)

    def look_up(
        self, image: NDArray[Pixel], rays: Array
    ) -> tuple[NDArray[Pixel], NDArray[np.bool_]]:
        """What an image shows in directions [H, W, 3], and which of them lie inside of it.

        Outside the nearest border pixel stands in.
        """
        depth = np.maximum(rays[..., 2], _NEAREST)
        middle, last = (self.size - 1) / 2, self.size - 1
        u, v = (self.focal_px[axis] * rays[..., axis] / depth + middle for axis in (0, 1))
        is_inside = (u >= 0) & (u <= last) & (v >= 0) & (v <= last) & (rays[..., 2] > _NEAREST)
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
        """The image that the camera would see after a turn of the body, were all things far away.

        Args:
            image: [size, size, 3] as it was seen before.
            ned_from_before: [3, 3] attitude then, from FRD body axes.
            ned_from_after: [3, 3] attitude afterwards.
        """
        before_from_after = self.frd_from_camera.T @ (
            ned_from_before.T @ ned_from_after @ self.frd_from_camera
        )
        seen, _ = self.look_up(image, self.rays() @ before_from_after.T)
        return seen


def make_lens(meta: FlightMeta, size: int, assumed: Mounting) -> Lens:
    """The camera of a flight, for its images resized to ``size`` squares."""
    told = meta.conditions
    is_recorded = {"horizontal_fov_rad", "camera_tilt_rad"} <= set(told)
    fov_rad = told["horizontal_fov_rad"] if is_recorded else assumed.horizontal_fov_rad
    tilt_rad = told["camera_tilt_rad"] if is_recorded else assumed.tilt_up_rad
    width, height = meta.source_width or 1, meta.source_height or 1
    focal_px = size / 2 / math.tan(fov_rad / 2)  # the camera's own pixels are squares
    sine, cosine = math.sin(tilt_rad), math.cos(tilt_rad)
    tilted = np.array([[0.0, sine, cosine], [1.0, 0.0, 0.0], [0.0, cosine, -sine]])
    about_down = _about_third(told.get("camera_yaw_rad", 0.0))
    about_axis = _about_third(told.get("camera_roll_rad", 0.0))
    return Lens(
        size=size,
        focal_px=(focal_px, focal_px * width / height),
        frd_from_camera=about_down @ tilted @ about_axis,
        is_recorded=is_recorded,
    )


def _about_third(angle_rad: float) -> Array:
    sine, cosine = math.sin(angle_rad), math.cos(angle_rad)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def attitudes(states: FloatArray, frame: StateFrame) -> Array:
    """States [..., 13] -> rotations [..., 3, 3] from FRD body axes to NED."""
    quaternion = states[..., None, QUATERNION].astype(np.float64)
    world_from_body = np.swapaxes(rotation.rotate(quaternion, np.eye(3)), -1, -2)
    if frame == "ned_frd":
        return world_from_body
    turned: Array = NED_FROM_ENU @ world_from_body @ FRD_FROM_FLU
    return turned


def body_rates(states: FloatArray, frame: StateFrame) -> Array:
    """States [..., 13] -> body rates [..., 3] in FRD axes, rad/s."""
    rates = states[..., RATE].astype(np.float64)
    return rates if frame == "ned_frd" else rates @ FRD_FROM_FLU
