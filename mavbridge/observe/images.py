"""Recorded images in a form that viewers show."""

import cv2
import numpy as np

from mavbridge.core.records import CameraImage, ImageArray

JPEG_QUALITY = 85


def as_rgb(image: CameraImage) -> ImageArray:
    """Return the image in RGB; farther depth is darker, unknown is black."""
    if image.ndim == 3:
        return np.asarray(image, np.uint8)
    shares = 1.0 - image.astype(np.float32) / max(int(image.max()), 1)
    grey = np.where(image > 0, 55 + 200 * shares, 0).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=2)


def jpeg(rgb: ImageArray) -> bytes:
    """Encode an RGB image as JPEG."""
    bgr = cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)
    _, encoded = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return encoded.tobytes()
