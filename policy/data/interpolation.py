"""Interpolation of quantities with their own measurement times."""

import numpy as np
from numpy.typing import NDArray

from policy.contract import FloatArray
from policy.data.flight_data import Nanoseconds
from policy.motion import rotation

MAX_GAP_NS = 201_000_000
"""Longest gap between sticks or attitudes to interpolate across: 5 Hz, with rounded stamps."""

Indices = NDArray[np.int64]


class Interpolator:
    """Interpolates a quantity between measurements, and holds the end values outside them."""

    def __init__(self, at_ns: Nanoseconds, values: FloatArray) -> None:
        """Sort measurements [N, D] by their times [N]; of two at one time, the later counts."""
        order = np.argsort(at_ns, kind="stable")
        at_ns, values = at_ns[order], values[order]
        is_last = np.append(np.diff(at_ns) > 0, True)[: len(at_ns)]
        self._at_ns, self._values = at_ns[is_last], values[is_last].astype(np.float64)

    def covers(self, at_ns: Nanoseconds) -> NDArray[np.bool_]:
        """True for each time between two measurements that are not too far apart."""
        return covered(self._at_ns, at_ns)

    def vectors_at(self, at_ns: Nanoseconds) -> NDArray[np.float64]:
        """Interpolate linearly, [B, D]."""
        before, after, weight = self._around(at_ns)
        return (1.0 - weight[:, None]) * before + weight[:, None] * after

    def rotations_at(self, at_ns: Nanoseconds) -> NDArray[np.float64]:
        """Interpolate unit quaternions [B, 4], with a constant rate between two attitudes."""
        return rotation.slerp(*self._around(at_ns))

    def _around(
        self, at_ns: Nanoseconds
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        after = np.minimum(np.searchsorted(self._at_ns, at_ns), len(self._at_ns) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(self._at_ns[after] - self._at_ns[before], 1)
        weight = np.clip((at_ns - self._at_ns[before]) / span, 0.0, 1.0)
        return self._values[before], self._values[after], weight


def covered(known_ns: Nanoseconds, at_ns: Nanoseconds) -> NDArray[np.bool_]:
    """True for each time that is one of ``known_ns``, or between two that are not too far apart."""
    if len(known_ns) == 0:
        return np.zeros(at_ns.shape, bool)
    after = np.searchsorted(known_ns, at_ns, side="left")
    inside = np.minimum(after, len(known_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_near = known_ns[inside] - known_ns[before] <= MAX_GAP_NS
    is_between = (after > 0) & (after < len(known_ns)) & is_near
    out: NDArray[np.bool_] = is_between | (known_ns[inside] == at_ns)
    return out


def nearest(known_ns: Nanoseconds, at_ns: Nanoseconds) -> Indices:
    """Return the index of the nearest of ``known_ns`` for each time; the earlier one on a tie."""
    last = len(known_ns) - 1
    after = np.minimum(np.clip(np.searchsorted(known_ns, at_ns), 1, max(last, 1)), last)
    before = np.maximum(after - 1, 0)
    return np.where(at_ns - known_ns[before] <= known_ns[after] - at_ns, before, after)
