"""The first action that a policy decides for at a moment, beside the one that was recorded."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavbridge.simulation.replay.compare import Array


class ActionPair(NamedTuple):
    """One moment."""

    at_s: float
    """Since the recording began."""
    policy: tuple[float, ...]
    """[4] throttle, yaw, pitch, roll."""
    recorded: tuple[float, ...] | None
    """[4]; None: nobody had sticks then."""


@dataclass(frozen=True, kw_only=True)
class ActionComparison:
    """All moments of a recording."""

    times_s: Array
    """[N]"""
    policy: Array
    """[N, 4]"""
    recorded: Array
    """[N, 4]; NaN where nobody had sticks."""

    @property
    def difference(self) -> Array:
        """[M, 4] policy minus recorded, where there is something to compare with."""
        difference = self.policy - self.recorded
        return difference[np.isfinite(difference).all(axis=1)]


def compare_actions(pairs: Sequence[ActionPair]) -> ActionComparison:
    """Gather them."""
    nobody = (np.nan,) * 4
    return ActionComparison(
        times_s=np.array([pair.at_s for pair in pairs], np.float64),
        policy=np.array([pair.policy for pair in pairs], np.float64).reshape(-1, 4),
        recorded=np.array(
            [nobody if pair.recorded is None else pair.recorded for pair in pairs], np.float64
        ).reshape(-1, 4),
    )
