"""Looks that no flight had: uneven light, a veil of light, and parts that are covered.

A camera policy is trained on the light and the surfaces of its flights, and flies in others. What
is drawn here is no scene of anything: smooth fields of brightness stand for shadow, dusk and glare
alike, and rectangles for whatever stands in the way (Zhong et al., "Random Erasing Data
Augmentation", 2020).
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from policy.data.flight_data import ImageArray

SHARE = 0.25
"""Images that each of the three is done to; they are independent."""
FIELD_CELLS = 4
"""Most cells of a field along a side; one alone is the same everywhere."""
LIGHT = (0.12, 1.3)
"""Least and largest factor on the brightness."""
MOST_VEIL = 0.9
"""Most light that a veil adds, of white."""
MOST_COVERS = 3
COVER_SIDE = (0.08, 0.4)
"""Least and largest side of a cover, of the image's."""


def disturb(images: ImageArray, random: np.random.Generator) -> None:
    """Change images [B, height, width, 3] uint8 in place, each in its own way or not at all."""
    chances = random.random((len(images), 3)) < SHARE
    for image, (is_lit, is_veiled, is_covered) in zip(images, chances, strict=True):
        height, width, _ = image.shape
        if is_lit:
            low, high = map(math.log, LIGHT)
            light = np.exp(_field(random, (height, width), low, high))
            cv2.multiply(image, cv2.merge([light] * 3), dst=image, dtype=cv2.CV_8U)
        if is_veiled:
            veil = _field(random, (height, width), 0.0, 1.0) ** 2
            veil *= 255 * random.uniform(0.0, MOST_VEIL)
            cv2.add(image, cv2.merge([veil] * 3), dst=image, dtype=cv2.CV_8U)
        if is_covered:
            for _ in range(random.integers(1, MOST_COVERS + 1)):
                _cover(image, random)


def _field(
    random: np.random.Generator, shape: tuple[int, int], low: float, high: float
) -> NDArray[np.float32]:
    """A smooth field [height, width] within low .. high."""
    cells = random.integers(1, FIELD_CELLS + 1, size=2)
    coarse = random.uniform(low, high, cells).astype(np.float32)
    smooth = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(smooth, dtype=np.float32)


def _cover(image: ImageArray, random: np.random.Generator) -> None:
    """Paint one rectangle of one colour, partly beyond the image's edge at times."""
    size = np.array(image.shape[:2])
    half = (random.uniform(*COVER_SIDE, 2) / 2 * size).astype(int)
    middle = random.integers(size)
    top, left = np.maximum(middle - half, 0)
    bottom, right = middle + half + 1
    image[top:bottom, left:right] = random.integers(0, 256, 3)
