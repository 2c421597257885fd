"""Convert actions between the axes of the policy's contract and those of the guard.

The guard, its limits and MAVLink use NED world and FRD body axes. A policy with ``state_frame =
"enu_flu"`` (ROS, REP 103) outputs actions, and reads its action history, in ENU and FLU. The
conversion is its own inverse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mavbridge.core.records import FloatArray
from mavbridge.core.vehicle import ACTION_CLASSES, NEUTRAL, Action
from policy.contract import Contract


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionFrame:
    """Kind of the policy's actions, and the permutation and signs that convert them to NED and
    FRD."""

    neutral: Action = NEUTRAL
    """Neutral action of the policy's kind: zeros, or zeros with hover thrust. Equal in both
    frames."""
    order: tuple[int, ...] = (0, 1, 2, 3)
    signs: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    """Component ``i`` in one frame is ``signs[i]`` times component ``order[i]`` in the other."""

    def to_guard(self, actions: FloatArray) -> tuple[Action, ...]:
        """Convert policy actions [horizon, 4] to NED and FRD actions."""
        kind = type(self.neutral)
        return tuple(map(kind._make, self._other_axes(actions).tolist()))

    def from_guard(self, actions: Sequence[Action]) -> FloatArray:
        """Convert sent actions of the policy's kind to its frame, [len, 4]."""
        return self._other_axes(np.array(actions, dtype=np.float32))

    def _other_axes(self, actions: FloatArray) -> FloatArray:
        if self.order == (0, 1, 2, 3) and self.signs == (1.0, 1.0, 1.0, 1.0):
            return actions
        return actions[:, self.order] * np.array(self.signs, dtype=np.float32)


def action_frame(contract: Contract) -> ActionFrame:
    """Return the frame conversion and action kind of a contract."""
    kind = contract.action
    cls = ACTION_CLASSES[kind]
    has_thrust = kind in ("rates", "attitude")
    neutral = cls(contract.hover_thrust, 0.0, 0.0, 0.0) if has_thrust else cls(0.0, 0.0, 0.0, 0.0)
    if contract.state_frame == "ned_frd" or kind == "sticks":
        return ActionFrame(neutral=neutral)
    if kind == "velocity" and contract.velocity_frame == "world":
        # East, north, up, left turn <-> north, east, down, right turn.
        return ActionFrame(neutral=neutral, order=(1, 0, 2, 3), signs=(1.0, 1.0, -1.0, -1.0))
    if kind == "velocity":  # forward, left, up <-> forward, right, down
        return ActionFrame(neutral=neutral, signs=(1.0, -1.0, -1.0, -1.0))
    return ActionFrame(neutral=neutral, signs=(1.0, 1.0, -1.0, -1.0))
