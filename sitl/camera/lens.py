"""Drops and dirt on the lens: translucent blobs, the same in every frame of a flight."""

import cv2
import numpy as np
from numpy.typing import NDArray

from sitl.vehicle.conditions import Conditions

Image = NDArray[np.uint8]


class LensDirt:
    """Drops with soft edges; each shows a blurred view, darker (dirt) or brighter (water)."""

    def __init__(self, conditions: Conditions, width: int, height: int) -> None:
        random = np.random.Generator(np.random.PCG64((conditions.seed, 10)))
        u, v = np.arange(width) / width, np.arange(height)[:, None] / width
        self._clear, self._drop = np.ones((2, height, width, 1), np.float32)
        for _ in range(round(conditions.lens_drops)):
            stretch, radius = random.uniform((0.7, 0.05), (1.4, 0.16))  # as a share of the width
            right, down = u - random.random(), v - random.random() * height / width
            away = np.hypot(right * stretch, down / stretch)[..., None] / radius
            opacity = random.uniform(0.6, 1.0) * np.clip(2.0 - 2.0 * away, 0, 1)
            self._clear *= 1.0 - opacity
            self._drop *= 1.0 + opacity * random.uniform(-0.6, 0.3)
        self._drop *= 1.0 - self._clear

    def cover(self, image: Image) -> Image:
        """Return the image [H, W, 3] as seen through the lens."""
        blurred = cv2.GaussianBlur(image, (0, 0), 0.05 * image.shape[1])
        return np.clip(self._clear * image + self._drop * blurred, 0, 255).astype(np.uint8)
