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
"""Motion on the optical axis between two of the images that a smeared one is the mean of."""
MOST_SMEARED = 8
"""Most images in that mean."""
STILL: Vec3 = (0.0, 0.0, 0.0)
"""The rate of a camera that does not turn."""

Pixels = NDArray[np.float32]


class Shutter:
    """Exposes row after row, from top to bottom; a frame's stamp is the middle of both."""

    def __init__(self, conditions: Conditions, *, u_px: Pixels, v_px: Pixels, focal_px: float):
        """Take pixel coordinates [W] and [H, 1] of an image whose middle is on the optical axis."""
        self._exposure_s, readout_s = conditions.exposure_time_s, conditions.readout_time_s
        self._u_px, self._v_px, self._focal_px = u_px, v_px, focal_px
        self._x = (u_px - u_px.mean()) / np.float32(focal_px)
        self._y = (v_px - v_px.mean()) / np.float32(focal_px)
        rows_s = np.linspace(-readout_s / 2, readout_s / 2, len(v_px), dtype=np.float32)
        self._rows_s = rows_s[:, None]
        self._is_instant = conditions.frame_time_s == 0.0

    def expose(self, image: Image, rate_camera_radps: FloatArray) -> Image:
        """The image [H, W, 3] of a camera that turns; may be the argument itself.

        ``rate_camera_radps`` [3] is about the camera's axes: right, down, forward. Where the view
        moves in from beyond the image, its edge is repeated.
        """
        turn_radps = float(np.linalg.norm(rate_camera_radps))
        if self._is_instant or turn_radps == 0.0:
            return image
        flow_pxps = self.flow_pxps(rate_camera_radps)
        smear_px = turn_radps * self._exposure_s * self._focal_px
        count = min(MOST_SMEARED, 1 + math.ceil(smear_px / SMEAR_STEP_PX))
        at_s = self._exposure_s * ((np.arange(count) + 0.5) / count - 0.5)
        moved = [self._moved(image, flow_pxps, self._rows_s + np.float32(t_s)) for t_s in at_s]
        if count == 1:
            return moved[0]
        return np.asarray(np.mean(moved, axis=0).round(), dtype=np.uint8)

    def flow_pxps(self, rate_camera_radps: FloatArray) -> tuple[Pixels, Pixels]:
        """Where the ray of a pixel was at the stamp, right and down, for each second since then.

        The ray r = (x, y, 1) of a camera that has turned for t was r + t * cross(rate, r) then.
        """
        right_radps, down_radps, ahead_radps = rate_camera_radps.astype(np.float32)
        deeper = right_radps * self._y - down_radps * self._x
        flow_right = down_radps - ahead_radps * self._y - self._x * deeper
        flow_down = ahead_radps * self._x - right_radps - self._y * deeper
        focal_px = np.float32(self._focal_px)
        return focal_px * flow_right, focal_px * flow_down

    def _moved(self, image: Image, flow_pxps: tuple[Pixels, Pixels], at_s: Pixels) -> Image:
        """The view at times [H, 1] after the stamp."""
        flow_right, flow_down = flow_pxps
        moved = cv2.remap(
            image,
            self._u_px + at_s * flow_right,
            self._v_px + at_s * flow_down,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        return np.asarray(moved, dtype=np.uint8)
