"""What a camera that turns during a frame makes of it: motion blur and a rolling shutter.

Only rotation counts: the pixels of a view move by the camera's body rate alone, whatever is in it
(Longuet-Higgins and Prazdny, "The Interpretation of a Moving Retinal Image", 1980). Motion by the
vehicle's speed is left out: at 8 m/s, 5 m before a gate, it is 1.1 rad/s at 45 degrees from ahead.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl.camera.scenery import FloatArray, Image
from sitl.rotation import Vec3
from sitl.vehicle.conditions import Conditions

SMEAR_STEP_PX = 1.5
"""Largest motion between two of the images that a smeared one is the mean of."""
MOST_SMEARED = 8
"""Most images in that mean."""

STILL: Vec3 = (0.0, 0.0, 0.0)
"""The rate of a camera that does not turn."""

Pixels = NDArray[np.float32]


class Shutter:
    """Exposes row after row, from top to bottom; a frame's stamp is the middle of both."""

    def __init__(self, conditions: Conditions, width: int, height: int, *, focal_px: float) -> None:
        self._exposure_s, readout_s = conditions.exposure_time_s, conditions.readout_time_s
        self.is_instant = self._exposure_s == 0.0 and readout_s == 0.0
        """Nothing turns during a frame."""
        self._focal_px = focal_px
        self._u_px = np.arange(width, dtype=np.float32)
        self._v_px = np.arange(height, dtype=np.float32)[:, None]
        self._x = (self._u_px - np.float32((width - 1) / 2)) / np.float32(focal_px)
        self._y = (self._v_px - np.float32((height - 1) / 2)) / np.float32(focal_px)
        self._row_s = np.linspace(-readout_s / 2, readout_s / 2, height, dtype=np.float32)[:, None]

    def expose(self, image: Image, rate_camera_radps: FloatArray) -> Image:
        """The image [H, W, 3] of a camera that turns; may be the argument itself.

        ``rate_camera_radps`` [3] is about the camera's axes: right, down, forward. Where the view
        moves in from beyond the image, its edge is repeated.
        """
        turn_radps = float(np.linalg.norm(rate_camera_radps))
        if self.is_instant or turn_radps == 0.0:
            return image
        flow_u, flow_v = self._flow(rate_camera_radps)
        smear_px = turn_radps * self._exposure_s * self._focal_px
        count = min(MOST_SMEARED, 1 + math.ceil(smear_px / SMEAR_STEP_PX))
        at_s = self._exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        moved = [self._moved(image, flow_u, flow_v, self._row_s + np.float32(t)) for t in at_s]
        if count == 1:
            return moved[0]
        return np.asarray(np.mean(moved, axis=0).round(), dtype=np.uint8)

    def _flow(self, rate_camera_radps: FloatArray) -> tuple[Pixels, Pixels]:
        """Where the ray of a pixel was at the stamp, in pixels for each second since then.

        The ray r = (x, y, 1) of a camera that has turned for t was r + t * cross(rate, r) then.
        """
        about_x, about_y, about_z = rate_camera_radps.astype(np.float32)
        nearer = about_x * self._y - about_y * self._x
        flow_u = about_y - about_z * self._y - self._x * nearer
        flow_v = about_z * self._x - about_x - self._y * nearer
        focal_px = np.float32(self._focal_px)
        return focal_px * flow_u, focal_px * flow_v

    def _moved(self, image: Image, flow_u: Pixels, flow_v: Pixels, at_s: Pixels) -> Image:
        """The view at times [H, 1] after the stamp."""
        moved = cv2.remap(
            image,
            self._u_px + at_s * flow_u,
            self._v_px + at_s * flow_v,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(moved, dtype=np.uint8)
