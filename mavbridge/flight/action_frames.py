"""Convert actions between the axes of the policy's contract and those of the guard.

The guard, its limits and MAVLink use NED world and FRD body axes. A policy with ``state_frame =
"enu_flu"`` (ROS, REP 103) outputs actions, and reads its action history, in ENU and FLU. The
conversion is its own inverse.
"""

from collections.abc import Sequence

import numpy as np

from mavbridge.core.records import FloatArray
from mavbridge.core.vehicle import ACTION_CLASSES, Action
from policy.contract import Contract


class ActionFrame:
    """Kind and axes of a policy's actions; converts them to NED and FRD, and back."""

    def __init__(self, contract: Contract) -> None:
        thrust = contract.hover_thrust if contract.action in ("rates", "attitude") else 0.0
        self.neutral: Action = ACTION_CLASSES[contract.action](thrust, 0.0, 0.0, 0.0)
        """Zeros, or zeros with hover thrust. Equal in both frames."""
        self._axes = _other_axes(contract)

    def to_guard(self, actions: FloatArray) -> tuple[Action, ...]:
        """Convert policy actions [horizon, 4] to NED and FRD actions."""
        kind = type(self.neutral)
        return tuple(map(kind._make, self._converted(actions).tolist()))

    def from_guard(self, actions: Sequence[Action]) -> FloatArray:
        """Convert sent actions of the policy's kind to its frame, [len, 4]."""
        return self._converted(np.array(actions, dtype=np.float32))

    def _converted(self, actions: FloatArray) -> FloatArray:
        if self._axes is None:
            return actions
        order, signs = self._axes
        return actions[:, order] * np.array(signs, dtype=np.float32)


def _other_axes(contract: Contract) -> tuple[tuple[int, ...], tuple[float, ...]] | None:
    """Return order and signs of the conversion: component ``i`` in one frame is ``signs[i]`` times
    component ``order[i]`` in the other. None: the frames are the same."""
    kind = contract.action
    if contract.state_frame == "ned_frd" or kind == "sticks":
        return None
    if kind == "velocity" and contract.velocity_frame == "world":
        # East, north, up, left turn <-> north, east, down, right turn.
        return (1, 0, 2, 3), (1.0, 1.0, -1.0, -1.0)
    if kind == "velocity":  # forward, left, up <-> forward, right, down
        return (0, 1, 2, 3), (1.0, -1.0, -1.0, -1.0)
    return (0, 1, 2, 3), (1.0, 1.0, -1.0, -1.0)
