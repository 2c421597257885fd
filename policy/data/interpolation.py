"""Quantities that a flight tells at its own times, at any other time."""

import numpy as np
from numpy.typing import NDArray

from policy import rotation
from policy.contract import FloatArray
from policy.data.episodes import Nanoseconds

MAX_GAP_NS = 200_000_000
"""Sticks and attitudes further apart are not interpolated."""

Indices = NDArray[np.int64]


class Knots:
    """A quantity at increasing times, the newest where two arrived at once."""

    def __init__(self, at_ns: Nanoseconds, values: FloatArray) -> None:
        order = np.argsort(at_ns, kind="stable")
        at_ns, values = at_ns[order], values[order]
        is_last = np.append(np.diff(at_ns) > 0, True)[: len(at_ns)]
        self._at_ns, self._values = at_ns[is_last], values[is_last].astype(np.float64)

    def covers(self, at_ns: Nanoseconds) -> NDArray[np.bool_]:
        """Whether each time lies between two values that are not too far apart."""
        return covered(self._at_ns, at_ns)

    def vectors_at(self, at_ns: Nanoseconds) -> NDArray[np.float64]:
        """Linear between the values."""
        before, after, weight = self._around(at_ns)
        return (1.0 - weight[:, None]) * before + weight[:, None] * after

    def rotations_at(self, at_ns: Nanoseconds) -> NDArray[np.float64]:
        """Between two attitudes, a unit quaternion."""
        return rotation.slerp(*self._around(at_ns))

    def _around(
        self, at_ns: Nanoseconds
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        after = np.minimum(np.searchsorted(self._at_ns, at_ns), len(self._at_ns) - 1)
        before = np.maximum(after - 1, 0)
        span = np.maximum(self._at_ns[after] - self._at_ns[before], 1)
        weight = np.clip((at_ns - self._at_ns[before]) / span, 0.0, 1.0)
        return self._values[before], self._values[after], weight


def covered(knots_ns: Nanoseconds, at_ns: Nanoseconds) -> NDArray[np.bool_]:
    """Whether each time is one of ``knots_ns``, or between two that are not too far apart."""
    if len(knots_ns) == 0:
        return np.zeros(at_ns.shape, bool)
    after = np.searchsorted(knots_ns, at_ns, side="left")
    inside = np.minimum(after, len(knots_ns) - 1)
    before = np.maximum(after - 1, 0)
    is_near = knots_ns[inside] - knots_ns[before] <= MAX_GAP_NS
    is_between = (after > 0) & (after < len(knots_ns)) & is_near
    out: NDArray[np.bool_] = is_between | (knots_ns[inside] == at_ns)
    return out
