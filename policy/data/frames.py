"""Images of all flights, decoded once, as one array on disk."""

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from policy.data.flight_data import FlightData, ImageArray
from policy.errors import DatasetError
from policy.preprocess import resize

_SPARE_BYTES = 1 << 30
"""Disk space to leave free for checkpoints and logs."""


def store_frames(
    flights: Sequence[FlightData],
    path: Path,
    size: int,
    progress: Callable[[float], None] = lambda _: None,
) -> tuple[ImageArray, list[float]]:
    """Decode all images into a file, and resize them to ``size`` pixels a side, as in flight.

    Return them [N, size, size, 3], numbered across all flights in order, and the width by height
    that they had, each once. ``progress`` is called with the completed fraction.
    """
    need = sum(len(flight.captured_ns) for flight in flights) * size * size * 3
    free = shutil.disk_usage(path.parent).free
    if need + _SPARE_BYTES > free:
        raise DatasetError(
            f"{path.parent}: the decoded images take {need / 1e9:.1f} GB and {free / 1e9:.1f} GB "
            "are free: choose a smaller --image-size, fewer flights, or an --out elsewhere"
        )
    proportions = set[float]()
    with path.open("wb") as file:  # not memory-mapped: a full disk under a map kills a process
        for count, flight in enumerate(flights, start=1):
            for image in flight.decode():
                proportions.add(round(image.shape[1] / image.shape[0], 2))
                file.write(np.ascontiguousarray(resize(image, size, size)).data)
            progress(count / len(flights))
    images = np.memmap(path, np.uint8, mode="r").reshape(-1, size, size, 3)
    return images, sorted(proportions)


def shifted(images: ImageArray, shifts: NDArray[np.int64]) -> ImageArray:
    """Move square images [B, side, side, 3] down and right by pixels [B, 2]; edges are repeated."""
    side = np.arange(images.shape[1])
    places = np.clip(side - shifts[..., None], 0, side[-1])
    moved = np.empty_like(images)
    for out, image, (down, right) in zip(moved, images, places, strict=True):
        out[:] = image[down][:, right]
    return moved
