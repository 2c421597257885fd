"""Preprocessing of camera images and vehicle states, shared by training and flight.

Images are cropped, fitted and normalised here, before the network, by the checkpoint's contract.
Networks turn the state into body axes and normalise it inside (``nets.toge.StateEncoder``) by
functions of this module, so a checkpoint takes SI units. No torch: scripted policies use this
module too.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from policy.contract import CameraImage, Contract, FloatArray
from policy.errors import PolicyError
from policy.motion.rotation import matrix_columns

_Pixel = TypeVar("_Pixel", np.uint8, np.uint8 | np.uint16)
STATE_SCALE = (
    *(5.0, 5.0, 5.0),  # m/s: a brisk pace through gates
    *(1.0, 1.0, 1.0, 1.0),  # a unit quaternion
    *(3.0, 3.0, 3.0),  # rad/s: about ArduPilot's default yaw and roll rates at full stick
    *(9.80665, 9.80665, 9.80665),  # m/s^2: standard gravity
)
"""Divisor of each number of the state; the quotient is within [-1, 1] in typical flight.

Fixed, not estimated from data: all checkpoints share it, and a sensor in the wrong unit shows.
"""

SINCE_EXPOSURE_SCALE = (
    0.1,  # s: about the age at which an image is too old to use
    *(0.5, 0.5, 0.5),  # rad: an image turned by half its width
    *(2.0, 2.0, 2.0),  # m/s: two tenths of a second of hard acceleration
)
"""Divisors of ``SINCE_EXPOSURE_NAMES``, the optional numbers after the state."""

EGOCENTRIC_SCALE = (
    *(5.0, 5.0, 5.0),  # m/s
    *(1.0, 1.0, 1.0),  # a unit vector
    *STATE_SCALE[7:],  # body rates and specific force, unchanged
)
"""Divisors of the numbers of ``egocentric_columns``."""


def egocentric_scale(contract: Contract) -> tuple[float, ...]:
    """Return the divisor of each number of ``egocentric_columns``."""
    return EGOCENTRIC_SCALE + (SINCE_EXPOSURE_SCALE if contract.since_exposure else ())


def egocentric_columns(columns: Sequence[Any]) -> list[Any]:
    """Return the state relative to the vehicle: independent of the heading and of the sign of q.

    Velocity in body axes and the world's vertical axis in body axes, then rates, specific force and
    the contract's optional inputs, unchanged. So a network has no rotations to learn, and cannot
    recognise a course by its heading. Columns are floats or arrays of any library, in the
    contract's order; the output has one number fewer than the input, 12 or 19.
    """
    vx, vy, vz, w, x, y, z, *rest = columns
    axes = matrix_columns(w, x, y, z)
    velocity_body = [vx * a + vy * b + vz * c for a, b, c in axes]
    return [*velocity_body, *(axis[2] for axis in axes), *rest]


def image_to_input(image: CameraImage, contract: Contract) -> FloatArray:
    """Convert a camera image to float32 [1, 3, image_height, image_width]; depth [1, 1, ...].

    ``fit_image`` fits it, then ``(value / 255 - mean) / std`` of the contract normalises it, with
    the channels in the contract's order. Depth is converted to metres.
    """
    fitted = fit_image(image, contract)
    if contract.is_depth:
        return np.multiply(fitted, np.float32(contract.depth_unit_m), dtype=np.float32)[None, None]
    scale, offset = _scale_offset(contract)
    planes = np.empty((1, 3, contract.image_height, contract.image_width), np.float32)
    for place, colour in enumerate((0, 1, 2) if contract.image_channels == "rgb" else (2, 1, 0)):
        np.multiply(fitted[..., colour], scale[colour], out=planes[0, place])
        planes[0, place] += offset[colour]
    return planes


def input_to_bytes(planes: FloatArray, contract: Contract) -> FloatArray:
    """Undo the normalisation of ``image_to_input``: [..., 3, H, W] -> whole numbers 0 to 255."""
    if contract.is_depth:
        raise PolicyError(
            "it takes its image as uint8, and the contract's is depth in metres: export it with "
            "an image of type float"
        )
    scale, offset = _scale_offset(contract)
    colours = [0, 1, 2] if contract.image_channels == "rgb" else [2, 1, 0]
    per_plane = (3, 1, 1)
    values = (planes - offset[colours].reshape(per_plane)) / scale[colours].reshape(per_plane)
    whole: FloatArray = np.rint(values).clip(0.0, 255.0).astype(np.float32)
    return whole


def fit_image(image: CameraImage, contract: Contract) -> CameraImage:
    """Crop and resize a camera image of any size by the contract, to ``Contract.picture_shape``."""
    kind = (np.dtype(np.uint16), ()) if contract.is_depth else (np.dtype(np.uint8), (3,))
    if image.ndim < 2 or (image.dtype, image.shape[2:]) != kind or 0 in image.shape:
        wanted = (
            "uint16 [height, width]: depth" if contract.is_depth else "uint8 [height, width, 3]"
        )
        raise PolicyError(
            f"an image must be {wanted} by image_channels {contract.image_channels!r}, got "
            f"{image.dtype} {list(image.shape)}: use a camera of that kind"
        )
    height, width = contract.image_height, contract.image_width
    top, left, bottom, right = contract.image_crop
    image = image[_part(len(image), top, bottom), _part(image.shape[1], left, right)]
    tall, wide = height / image.shape[0], width / image.shape[1]
    if contract.image_fit == "stretch" or tall == wide:
        return resize(image, height, width)
    if contract.image_fit == "crop":
        spare_rows, spare_columns = (0.5 - side / max(tall, wide) / 2 for side in (tall, wide))
        rows = _part(image.shape[0], spare_rows, 1 - spare_rows)
        columns = _part(image.shape[1], spare_columns, 1 - spare_columns)
        return resize(image[rows, columns], height, width)
    least = min(tall, wide)
    inner_height, inner_width = (max(round(side * least), 1) for side in image.shape[:2])
    inner = resize(image, inner_height, inner_width)
    above, beside = (height - inner.shape[0]) // 2, (width - inner.shape[1]) // 2
    padded = np.zeros(contract.picture_shape, image.dtype)
    padded[above : above + inner.shape[0], beside : beside + inner.shape[1]] = inner
    return padded


def least_source_px(contract: Contract) -> tuple[int, int]:
    """Return the least height and width of a camera image [px] that need no enlarging."""
    top, left, bottom, right = contract.image_crop
    height, width = contract.image_height / (bottom - top), contract.image_width / (right - left)
    return math.ceil(height), math.ceil(width)


def _part(length: int, start: float, end: float) -> slice:
    """Return the pixels between two shares of a side; at least one."""
    first = min(round(start * length), length - 1)
    return slice(first, max(round(end * length), first + 1))


def resize(rgb: NDArray[_Pixel], height: int, width: int) -> NDArray[_Pixel]:
    """Resize [H, W, 3] to [height, width, 3], or depth [H, W]; no copy if the size fits."""
    if rgb.shape[:2] == (height, width):
        return rgb
    shrinks = rgb.shape[0] > height or rgb.shape[1] > width
    # Area averaging does not alias when shrinking; it is nearest-neighbour when enlarging.
    interpolation = cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR
    if rgb.ndim == 2:  # averages of near, far or unknown pixels are not distances
        interpolation = cv2.INTER_NEAREST
    resized = cv2.resize(np.ascontiguousarray(rgb), (width, height), interpolation=interpolation)
    return resized.astype(rgb.dtype, copy=False)


@lru_cache(maxsize=8)
def _scale_offset(contract: Contract) -> tuple[FloatArray, FloatArray]:
    mean = np.asarray(contract.image_mean_rgb)
    std = np.asarray(contract.image_std_rgb)
    return (1.0 / (255.0 * std)).astype(np.float32), (-mean / std).astype(np.float32)
