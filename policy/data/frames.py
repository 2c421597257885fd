"""Images of all flights, decoded once, as arrays on disk."""

import shutil
from collections.abc import Callable, Collection, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from policy.data.flight_data import DatasetError, FlightData, ImageArray
from policy.preprocess import resize

_SPARE_BYTES = 1 << 30
"""Disk space to leave free for checkpoints and logs."""


class FrameStore:
    """Images of flights [N, height, width, 3] uint8, numbered across all flights in order."""

    def __init__(self, arrays: Sequence[ImageArray], proportions: Collection[float] = ()) -> None:
        self._arrays = arrays
        self.proportions = sorted(proportions)
        """Width by height of the images before they were made square, each once."""
        self.counts = [len(array) for array in arrays]
        """Number of images of each flight."""
        self._starts = np.cumsum([0, *self.counts])

    def only(self, flights: Sequence[int]) -> "FrameStore":
        """Return the images of some flights, renumbered."""
        return FrameStore([self._arrays[index] for index in flights])

    def read(
        self,
        frames: NDArray[np.int64],
        shifts: NDArray[np.int64] | None = None,
        *,
        is_mirrored: bool = False,
    ) -> ImageArray:
        """Return images [B, height, width, 3], mirrored or not.

        ``shifts`` [B, 2] are pixels down and right; the edge of a shifted image is repeated.
        """
        out = np.empty((len(frames), *self._arrays[0].shape[1:]), np.uint8)
        flights = np.searchsorted(self._starts, frames, side="right") - 1
        for row, (frame, flight) in enumerate(zip(frames, flights, strict=True)):
            image = np.asarray(self._arrays[flight][frame - self._starts[flight]])
            if shifts is not None:
                image = _shift(image, shifts[row])
            out[row] = image
        return np.ascontiguousarray(out[:, :, ::-1]) if is_mirrored else out


def _shift(image: ImageArray, shift: NDArray[np.int64]) -> ImageArray:
    down, right = int(shift[0]), int(shift[1])
    if down == 0 and right == 0:
        return image
    pad = max(abs(down), abs(right))
    padded = cv2.copyMakeBorder(image, pad, pad, pad, pad, cv2.BORDER_REPLICATE)
    height, width = image.shape[:2]
    top, left = pad - down, pad - right
    moved = padded[top : top + height, left : left + width]
    return moved.astype(np.uint8, copy=False)


def store_frames(
    flights: Sequence[FlightData],
    folder: Path,
    size: int,
    progress: Callable[[float], None] = lambda _: None,
) -> FrameStore:
    """Decode all images into a folder, and resize them to ``size`` pixels a side, as in flight.

    ``progress`` is called with the completed fraction.
    """
    folder.mkdir(parents=True, exist_ok=True)
    need = sum(len(flight.captured_ns) for flight in flights) * size * size * 3
    free = shutil.disk_usage(folder).free
    if need + _SPARE_BYTES > free:
        raise DatasetError(
            f"{folder}: the decoded images take {need / 1e9:.1f} GB and {free / 1e9:.1f} GB "
            "are free: choose a smaller --image-size, fewer flights, or an --out elsewhere"
        )
    arrays, proportions = [], set[float]()
    for index, flight in enumerate(flights):
        path = folder / f"{index}.rgb"
        with path.open("wb") as file:  # not memory-mapped: a full disk under a map kills a process
            for image in flight.decode():
                proportions.add(round(image.shape[1] / image.shape[0], 2))
                file.write(np.ascontiguousarray(resize(image, size, size)).data)
        arrays.append(np.memmap(path, np.uint8, mode="r").reshape(-1, size, size, 3))
        progress((index + 1) / len(flights))
    return FrameStore(arrays, proportions)
