"""Detection of a camera that keeps delivering but shows nothing: a frozen or blank image."""

import numpy as np

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import CameraImage

TAKEOFF_NS = 2 * NS_PER_S
"""Time for which the image may stay at rest after the vehicle was last reported as landed: the
motors spin up and the thrust rises before it leaves the ground (0.5 s in the simulator)."""
SAMPLED_ROWS = 32
"""Rows compared first: enough to tell two images of a real sensor apart by their noise."""
GRID = 32
"""Side of the sampling grid for the blank test [pixels]."""
DARK = 24
"""Brightest value of a dark pixel: video black is 16, and a covered sensor adds a little noise."""
PLAIN_SPREAD = 3
"""Largest deviation of a pixel of a plain image from its mean. An overcast sky with a noise of 1.5
levels exceeds it in one value of twenty, a decoder's grey in none."""
SHOWING_SHARE = 0.01
"""Share of the grid's values that must be neither dark nor plain; hot pixels are fewer."""


class ImageWatch:
    """Detects frozen and blank images; a limit of 0 disables its check.

    Frozen: no value of any pixel has changed for longer than the limit. In flight that is a fault
    of every source: a sensor's noise differs in every frame, and in the simulator's noiseless view
    from a hovering vehicle no image stays the same for 0.07 s. At rest on the ground a simulator
    draws the same image for ever, so the time counts only while the vehicle is airborne, and
    TAKEOFF_NS later than that.

    Blank: for longer than the limit, nearly all pixels have been dark (a lens cap, no exposure), of
    one colour (a lost video signal, a decoder without a key frame, dense fog), or unknown in a
    depth image. Blank images count on the ground as well.
    """

    def __init__(self, *, max_frozen_s: float, max_black_s: float) -> None:
        self._max_frozen_s = max_frozen_s
        self._max_black_s = max_black_s
        self._last: CameraImage | None = None
        self._changed_ns = 0
        self._grounded_ns: int | None = None
        self._blank_since_ns: int | None = None

    def check(self, rgb: CameraImage, captured_ns: int, *, is_airborne: bool) -> Reason | None:
        """Return the reason not to fly by this image, or None. Call it with each image, in order.

        ``rgb`` is kept for the next call and must not be changed. ``is_airborne`` is False if
        unknown.
        """
        blank = self._blank(rgb, captured_ns) if self._max_black_s > 0 else None
        frozen = self._frozen(rgb, captured_ns, is_airborne) if self._max_frozen_s > 0 else None
        return blank or frozen

    def _frozen(self, rgb: CameraImage, captured_ns: int, is_airborne: bool) -> Reason | None:
        last, self._last = self._last, rgb
        if last is None or not _is_same(last, rgb):
            self._changed_ns = captured_ns
        if not is_airborne:
            self._grounded_ns = captured_ns
        counted_from_ns = self._changed_ns
        if self._grounded_ns is not None:
            counted_from_ns = max(counted_from_ns, self._grounded_ns + TAKEOFF_NS)
        if captured_ns - counted_from_ns <= self._max_frozen_s * NS_PER_S:
            return None
        return because(Code.IMAGE_FROZEN, age_s=(captured_ns - self._changed_ns) / NS_PER_S)

    def _blank(self, rgb: CameraImage, captured_ns: int) -> Reason | None:
        if not is_blank(rgb):
            self._blank_since_ns = None
            return None
        if self._blank_since_ns is None:
            self._blank_since_ns = captured_ns
        blank_s = (captured_ns - self._blank_since_ns) / NS_PER_S
        if blank_s <= self._max_black_s:
            return None
        what = "without any depth" if rgb.ndim == 2 else "black or of one colour"
        return because(Code.IMAGE_BLANK, what=what, age_s=blank_s)


def _is_same(one: CameraImage, other: CameraImage) -> bool:
    """True if all pixels are equal; a few rows are compared first to save time."""
    step = max(1, len(one) // SAMPLED_ROWS)
    return np.array_equal(one[::step], other[::step]) and np.array_equal(one, other)


def is_blank(rgb: CameraImage) -> bool:
    """True if nearly all pixels are dark, or all of one colour, or of unknown depth.

    Equal depths are no fault: a wall looks like that.
    """
    height, width = rgb.shape[:2]
    grid = rgb[:: max(1, height // GRID), :: max(1, width // GRID)].reshape(-1, *rgb.shape[2:])
    enough = SHOWING_SHARE * grid.size
    if rgb.ndim == 2:
        return bool(np.count_nonzero(grid) < enough)
    if np.count_nonzero(grid > DARK) < enough:
        return True
    values = grid.astype(np.float32)
    return bool(np.count_nonzero(np.abs(values - values.mean(axis=0)) > PLAIN_SPREAD) < enough)
