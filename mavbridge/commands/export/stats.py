"""The statistics by which LeRobot normalises: of each feature, over an episode and over all.

Names, axes and shapes are those of lerobot 0.6.1, ``datasets/compute_stats.py``; the values are
exact where LeRobot estimates quantiles by a histogram.
"""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.records import ImageArray

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Stats: TypeAlias = dict[str, NDArray[np.float64] | NDArray[np.int64]]
"""By name; "count" is [1] int64, the others are as wide as the feature."""

_PIXEL_STEP = 2
"""Every second pixel in each direction represents an image's colours."""
_LEVELS = 256


def vector_stats(values: NDArray[np.generic]) -> Stats:
    """Statistics of each column of values [N, D] or [N], N >= 1."""
    numbers = values.reshape(len(values), -1).astype(np.float64)
    return {
        "min": numbers.min(axis=0),
        "max": numbers.max(axis=0),
        "mean": numbers.mean(axis=0),
        "std": numbers.std(axis=0),
        "count": np.array([len(numbers)], np.int64),
        **{name: np.quantile(numbers, at, axis=0) for name, at in QUANTILES.items()},
    }


class ImageStats:
    """Colours of many images, counted."""

    def __init__(self) -> None:
        self._counts = np.zeros((3, _LEVELS), np.int64)
        self._images = 0

    def add(self, rgb: ImageArray) -> None:
        """Count an image [H, W, 3] uint8."""
        for channel in range(3):
            sample = rgb[::_PIXEL_STEP, ::_PIXEL_STEP, channel].ravel()
            self._counts[channel] += np.bincount(sample, minlength=_LEVELS)
        self._images += 1

    def merge(self, other: "ImageStats") -> None:
        """Add the images that another has counted."""
        self._counts += other._counts
        self._images += other._images

    def stats(self) -> Stats:
        """Statistics [3, 1, 1] of colours in [0, 1]; "count" is the number of images."""
        levels = np.arange(_LEVELS) / (_LEVELS - 1)
        total = self._counts.sum(axis=1)
        mean = self._counts @ levels / total
        variance = self._counts @ levels**2 / total - mean**2
        up_to = np.cumsum(self._counts, axis=1)
        found: dict[str, NDArray[np.float64]] = {
            "min": levels[(self._counts > 0).argmax(axis=1)],
            "max": levels[_LEVELS - 1 - (self._counts[:, ::-1] > 0).argmax(axis=1)],
            "mean": mean,
            "std": np.sqrt(np.maximum(variance, 0.0)),
            **{
                name: levels[(up_to >= at * total[:, None]).argmax(axis=1)]
                for name, at in QUANTILES.items()
            },
        }
        out: Stats = {name: values.reshape(3, 1, 1) for name, values in found.items()}
        return out | {"count": np.array([self._images], np.int64)}
