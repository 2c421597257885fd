"""Imaging of a real sensor: exposure, colour cast, blur and noise."""

from typing import TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl.vehicle.conditions import Conditions

Image: TypeAlias = NDArray[np.uint8]

REFERENCE_WIDTH_PX = 224  # image width for which the conditions give the blur
NOISE_MARGIN_PX = 61
"""Noise is drawn once, this much larger than the image, and cropped anew for every frame."""


class Imager:
    """Applies the conditions' imaging; the n-th frame of a renderer always gets the same noise."""

    def __init__(self, conditions: Conditions, width: int, height: int) -> None:
        self._random = np.random.Generator(np.random.PCG64((conditions.seed, 3)))
        gains = conditions.exposure * np.array(conditions.white_balance)
        self._lut: Image | None = None
        if (gains != 1.0).any():
            levels = np.arange(256)[:, None] * gains
            self._lut = np.clip(levels.round(), 0, 255).astype(np.uint8).reshape(1, 256, 3)
        self._blur_px = conditions.blur_px * width / REFERENCE_WIDTH_PX
        self._noise: NDArray[np.int16] | None = None
        if conditions.image_noise > 0.0:
            shape = (height + NOISE_MARGIN_PX, width + NOISE_MARGIN_PX, 3)
            noise = conditions.image_noise * self._random.standard_normal(shape)
            self._noise = noise.round().astype(np.int16)

    def expose(self, image: Image) -> Image:
        """Image [H, W, 3] RGB as the sensor would record it; may be the argument itself."""
        if self._lut is not None:
            image = np.asarray(cv2.LUT(image, self._lut), dtype=np.uint8)
        if self._blur_px > 0.0:
            image = np.asarray(cv2.GaussianBlur(image, (0, 0), self._blur_px), dtype=np.uint8)
        if self._noise is not None:
            top, left = self._random.integers(NOISE_MARGIN_PX + 1, size=2)
            height, width, _ = image.shape
            noise = self._noise[top : top + height, left : left + width]
            image = np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), dtype=np.uint8)
        return image
