"""Units in which the networks of this project compute actions: about [-1, 1], neutral is 0.

They belong to the weights: other units would need another training.
"""

from dataclasses import dataclass

import numpy as np

from policy.contract import Contract, FloatArray

Four = tuple[float, float, float, float]

THRUST_HALF_RANGE = 1.25
"""In units of the thrust that hovers: 1 is 2.25 times hover, more than such vehicles have."""
RATE_RADPS = 4.0
YAW_RATE_RADPS = 2.1
LEAN_RAD = 1.0
SPEED_MPS = 15.0
CLIMB_MPS = 5.0


@dataclass(frozen=True, slots=True)
class ActionUnits:
    """An action is ``neutral + scale * x``, number by number, with x in [-1, 1]."""

    neutral: Four
    scale: Four

    @property
    def is_identity(self) -> bool:
        """Actions are x themselves."""
        return self == SAME_UNITS

    def to_network(self, actions: FloatArray, signal: float = 1.0) -> FloatArray:
        """Actions [..., 4] in the units of a contract -> x.

        ``signal`` is the share of clean actions in noisy ones, which hold as much of the neutral.
        """
        if self.is_identity:
            return actions
        neutral, scale = np.array(self.neutral, np.float32), np.array(self.scale, np.float32)
        x = (actions - np.float32(signal) * neutral) / scale
        return x.astype(np.float32, copy=False)

    def from_network(self, x: FloatArray, signal: float = 1.0) -> FloatArray:
        """The inverse."""
        if self.is_identity:
            return x
        neutral, scale = np.array(self.neutral, np.float32), np.array(self.scale, np.float32)
        actions: FloatArray = scale * x + np.float32(signal) * neutral
        return actions


SAME_UNITS = ActionUnits((0.0,) * 4, (1.0,) * 4)
"""Of sticks: x is the action."""


def action_units(contract: Contract) -> ActionUnits:
    """Units of the actions of a contract; of sticks they are the stick positions."""
    hover = contract.hover_thrust
    match contract.action:
        case "sticks":
            return SAME_UNITS
        case "rates":
            scale = (THRUST_HALF_RANGE * hover, RATE_RADPS, RATE_RADPS, YAW_RATE_RADPS)
        case "attitude":
            scale = (THRUST_HALF_RANGE * hover, LEAN_RAD, LEAN_RAD, YAW_RATE_RADPS)
        case "velocity":
            return ActionUnits((0.0,) * 4, (SPEED_MPS, SPEED_MPS, CLIMB_MPS, YAW_RATE_RADPS))
    return ActionUnits((hover, 0.0, 0.0, 0.0), scale)
