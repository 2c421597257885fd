"""How the vehicle turned between two images, told from their pixels."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mavbridge.commands.evaluate_imagination.lens import Array, Lens
from mavbridge.core.records import ImageArray

BLURS_PX = (3.0, 1.5, 0.7)
"""Coarse to fine; for images of 64 pixels, and in proportion for others."""
BLURRED_SIZE = 64
ROUNDS = 8
INLIER = 0.015
"""Difference of a pixel, of full scale, from which on it counts as of something that moved by
itself: gates, mostly. Of 0.007, 0.015 and 0.03 the best on recorded flights."""
_CLOSE_RAD = 1e-4
_STIFFNESS = 1e-4
"""Keeps a motion that an image without texture does not tell at zero."""

Floats = NDArray[np.float32]


def turn_between(
    before: ImageArray, after: ImageArray, lens: Lens, ned_from_before: Array
) -> Array:
    """Rotation vector [3] of the body from one image to the next, rad, in FRD axes.

    The images are aligned directly (B. D. Lucas and T. Kanade 1981, with S. Baker and I. Matthews'
    2004 warps and the robust weights of S. Geman and D. McClure 1987) by six numbers: a rotation,
    and a motion over level ground, which moves a pixel the more the farther below the horizon it
    is. Without the ground, flying forward looks like a turn. Only where the horizon is is taken
    from the attitude.

    Args:
        before: [size, size, 3]
        after: [size, size, 3]
        lens: of both.
        ned_from_before: [3, 3] attitude of the first image, from FRD body axes.
    """
    first, second = (image.astype(np.float32) / 255.0 for image in (before, after))
    rays = lens.rays()
    down_camera = lens.frd_from_camera.T @ ned_from_before[2]
    nearness = np.maximum(rays @ down_camera, 0.0)
    motion_px = _pixel_motion(rays, nearness, lens)
    turned, moved = np.eye(3), np.zeros(3)
    for blur_px in BLURS_PX:
        sigma_px = blur_px * lens.size / BLURRED_SIZE
        a, b = (_blurred(image, sigma_px) for image in (first, second))
        slopes = _slopes(a, motion_px)
        for _ in range(ROUNDS):
            seen, is_inside = lens.look_up(b, (rays + nearness[..., None] * moved) @ turned.T)
            difference = seen.astype(np.float64) - a
            step = _step(slopes, difference, is_inside)
            turned = turned @ np.asarray(cv2.Rodrigues(step[:3])[0])
            moved = moved + step[3:]
            if np.abs(step).max() < _CLOSE_RAD:
                break
    # The scene turns one way in camera axes, the camera the other.
    vector: Array = lens.frd_from_camera @ np.asarray(cv2.Rodrigues(turned.T)[0]).ravel()
    return vector


def _blurred(image: Floats, sigma_px: float) -> Floats:
    return cv2.GaussianBlur(image, (0, 0), sigma_px).astype(np.float32, copy=False)


def _pixel_motion(rays: Array, nearness: Array, lens: Lens) -> Array:
    """[H, W, 2, 6]: pixels across and down, by radian of scene rotation and by unit of motion."""
    x, y, zero = rays[..., 0], rays[..., 1], np.zeros_like(nearness)
    across = (-x * y, 1 + x * x, -y, nearness, zero, -x * nearness)
    down = (-(1 + y * y), x * y, x, zero, nearness, -y * nearness)
    stacked = np.stack([np.stack(across, axis=-1), np.stack(down, axis=-1)], axis=-2)
    motion: Array = stacked * np.array(lens.focal_px)[:, None]
    return motion


def _slopes(image: Floats, motion_px: Array) -> Array:
    """[H, W, 3 channels, 6]: how each value changes with each of the six numbers."""
    gradients = [cv2.Sobel(image, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1))]
    slopes: Array = np.stack(gradients, axis=-1) @ motion_px
    return slopes


def _step(slopes: Array, difference: Array, is_inside: NDArray[np.bool_]) -> Array:
    """[6] of Gauss and Newton's, each value weighted by how well it fits already."""
    weights = is_inside[..., None] / (1 + (difference / INLIER) ** 2) ** 2
    flat = slopes.reshape(-1, 6)
    weighted: Array = flat * weights.reshape(-1, 1)
    normal = weighted.T @ flat + _STIFFNESS * np.eye(6)
    step = -np.linalg.solve(normal, weighted.T @ difference.ravel())
    return np.asarray(step, np.float64)
