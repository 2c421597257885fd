"""A policy's actions, in the axes of its contract, and the same actions in the guard's.

The guard, the limits and MAVLink have NED world and FRD body axes. A policy with the state in
``enu_flu`` (ROS, REP 103) puts its actions out in those axes as well, and finds them so in its
history. Both ways are the same change of axes.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mavbridge.core.records import FloatArray
from mavbridge.core.vehicle import ACTION_CLASSES, NEUTRAL, Action
from policy.contract import Contract


@dataclass(frozen=True, slots=True, kw_only=True)
class ActionFrame:
    """Kind of a policy's actions, and how its axes lie to NED and FRD."""

    neutral: Action = NEUTRAL
    """Action of the policy's kind that does nothing: zeros, with the thrust that hovers. The same
    in both axes."""
    order: tuple[int, ...] = (0, 1, 2, 3)
    signs: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    """Number ``i`` in the one axes is ``signs[i]`` times number ``order[i]`` in the other."""

    def to_guard(self, actions: FloatArray) -> tuple[Action, ...]:
        """Actions [horizon, 4] of the policy -> the same in NED and FRD."""
        kind = type(self.neutral)
        return tuple(map(kind._make, self._other_axes(actions).tolist()))

    def from_guard(self, actions: Sequence[Action]) -> FloatArray:
        """Actions as they were sent -> [len, 4] in the policy's axes.

        An action of another kind is neutral: the guard has others while it gets the vehicle ready,
        and levels it by an attitude where a policy puts out body rates.
        """
        kind = type(self.neutral)
        own = [action if type(action) is kind else self.neutral for action in actions]
        return self._other_axes(np.array(own, dtype=np.float32))

    def _other_axes(self, actions: FloatArray) -> FloatArray:
        if self.order == (0, 1, 2, 3) and self.signs == (1.0, 1.0, 1.0, 1.0):
            return actions
        return actions[:, self.order] * np.array(self.signs, dtype=np.float32)


def action_frame(contract: Contract) -> ActionFrame:
    """Axes and kind of the actions under a contract."""
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
