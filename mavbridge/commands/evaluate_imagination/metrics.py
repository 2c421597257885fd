"""How alike two images are, and how two lists of numbers hang together."""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from mavbridge.core.records import ImageArray
from policy.training.world_model.losses import psnr_db as tensor_psnr_db

SSIM_SIGMA_PX, SSIM_SIDE_PX = 1.5, 11
SSIM_C1, SSIM_C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
LEAST_PAIRS = 3


def psnr_db(made: ImageArray, true: ImageArray) -> float:
    """Peak signal to noise ratio of two images, dB, as the training has it: at most 99."""
    return float(tensor_psnr_db(torch.from_numpy(made), torch.from_numpy(true)))


def ssim(made: ImageArray, true: ImageArray) -> float:
    """Structural similarity of two images [H, W, 3], -1 to 1: the mean of the three channels.

    Z. Wang, A. Bovik, H. Sheikh and E. Simoncelli 2004: a Gaussian window of 11 pixels and sigma
    1.5, K = 0.01 and 0.03, only where the whole window lies inside of the image.

    Raises:
        ValueError: the images are smaller than the window.
    """
    if min(made.shape[:2]) < SSIM_SIDE_PX:
        raise ValueError(f"SSIM takes {SSIM_SIDE_PX} pixels a side, got {made.shape[:2]}")
    x, y = made.astype(np.float64), true.astype(np.float64)
    mean_x, mean_y = _local_mean(x), _local_mean(y)
    variances = _local_mean(x * x) - mean_x**2 + _local_mean(y * y) - mean_y**2
    covariance = _local_mean(x * y) - mean_x * mean_y
    likeness = (2 * mean_x * mean_y + SSIM_C1) * (2 * covariance + SSIM_C2)
    likeness /= (mean_x**2 + mean_y**2 + SSIM_C1) * (variances + SSIM_C2)
    return float(likeness.mean())


def _local_mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    side = (SSIM_SIDE_PX, SSIM_SIDE_PX)
    blurred = cv2.GaussianBlur(values, side, SSIM_SIGMA_PX)
    edge = SSIM_SIDE_PX // 2
    return np.asarray(blurred, np.float64)[edge:-edge, edge:-edge]


def slope(given: Sequence[float], found: Sequence[float]) -> float | None:
    """Least-squares slope of what was found over what was given; None without any spread."""
    if not _tell_something(given):
        return None
    x, y = np.asarray(given, np.float64), np.asarray(found, np.float64)
    x = x - x.mean()
    return float((x * (y - y.mean())).sum() / (x * x).sum())


def spearman(given: Sequence[float], found: Sequence[float]) -> float | None:
    """Rank correlation, equal values sharing their mean rank; None where one never changes."""
    if not (_tell_something(given) and _tell_something(found)):
        return None
    return float(np.corrcoef(_ranks(given), _ranks(found))[0, 1])


def _tell_something(values: Sequence[float]) -> bool:
    return len(values) >= LEAST_PAIRS and max(values) > min(values)


def _ranks(values: Sequence[float]) -> NDArray[np.float64]:
    _, place, counts = np.unique(np.asarray(values), return_inverse=True, return_counts=True)
    ranks: NDArray[np.float64] = (np.cumsum(counts) - (counts - 1) / 2)[place]
    return ranks
