"""The axes of each kind of action: the number that moves each, and its meaning in training."""

import math
from collections.abc import Callable
from typing import NamedTuple

from mavbridge.core.records import VehicleState
from policy.contract import RATE, ActionKind, Contract
from policy.scripted.controllers import measure
from policy.scripted.programs import Axis

_DEGREES = math.degrees(1.0)


class Signal(NamedTuple):
    """Something that a state measures. + is right, forward, nose right, up."""

    name: str
    unit: str
    read: Callable[[VehicleState], float]
    measured_ns: Callable[[VehicleState], int]


class AxisChannel(NamedTuple):
    """One axis: a number of the action, and the motion that answers it."""

    axis: Axis
    column: int
    scale: float
    """From the number of the action to the signal's unit, or to shares of full stick; with the
    signs of the signal."""
    signal: Signal


_LEAN_RIGHT = Signal(
    "lean", "deg", lambda s: _DEGREES * measure(s.values).roll_rad, lambda s: s.attitude_ns
)
_LEAN_FORWARD = Signal(
    "lean", "deg", lambda s: -_DEGREES * measure(s.values).pitch_rad, lambda s: s.attitude_ns
)
_ROLL_RATE, _PITCH_RATE, _YAW_RATE = (
    Signal(name, "deg/s", read, lambda s: s.rate_ns)
    for name, read in (
        ("roll rate", lambda s: _DEGREES * float(s.values[RATE][0])),
        ("pitch rate", lambda s: -_DEGREES * float(s.values[RATE][1])),
        ("yaw rate", lambda s: _DEGREES * float(s.values[RATE][2])),
    )
)
_SPEED_RIGHT, _SPEED_FORWARD, _CLIMB_RATE = (
    Signal(name, "m/s", read, lambda s: s.velocity_ns)
    for name, read in (
        ("speed", lambda s: measure(s.values).right_mps),
        ("speed", lambda s: measure(s.values).forward_mps),
        ("climb rate", lambda s: measure(s.values).climb_mps),
    )
)
CHANNELS: dict[ActionKind, tuple[AxisChannel, ...]] = {
    "sticks": (
        AxisChannel("roll", 3, 1.0, _LEAN_RIGHT),
        AxisChannel("pitch", 2, 1.0, _LEAN_FORWARD),
        AxisChannel("yaw", 1, 1.0, _YAW_RATE),
        AxisChannel("climb", 0, 1.0, _CLIMB_RATE),
    ),
    "attitude": (
        AxisChannel("roll", 1, _DEGREES, _LEAN_RIGHT),
        AxisChannel("pitch", 2, -_DEGREES, _LEAN_FORWARD),
        AxisChannel("yaw", 3, _DEGREES, _YAW_RATE),
    ),
    "rates": (
        AxisChannel("roll", 1, _DEGREES, _ROLL_RATE),
        AxisChannel("pitch", 2, -_DEGREES, _PITCH_RATE),
        AxisChannel("yaw", 3, _DEGREES, _YAW_RATE),
    ),
    "velocity": (
        AxisChannel("roll", 1, 1.0, _SPEED_RIGHT),
        AxisChannel("pitch", 0, 1.0, _SPEED_FORWARD),
        AxisChannel("yaw", 3, _DEGREES, _YAW_RATE),
        AxisChannel("climb", 2, -1.0, _CLIMB_RATE),
    ),
}
"""The axes that the doublet of each kind of action pushes."""

SIMULATOR_TIME_63_S: dict[ActionKind, dict[Axis, float]] = {
    "sticks": {"roll": 0.16, "pitch": 0.16, "yaw": 0.20, "climb": 0.67},
    "attitude": {},
    "rates": {},
    "velocity": {},
}
"""From a step of the action to 63 % of its effect on the bundled simulator with ArduCopter's
defaults, at the larger push, by this command: what the shipped policy was trained on."""


def trained_motion(contract: Contract, axis: Axis, amount: float) -> float:
    """Motion that a policy expects of an action held at ``amount`` on one axis.

    Args:
        contract: the policy's.
        axis: the axis.
        amount: of full stick where the actions are sticks; else what is commanded, and expected.
    """
    if contract.action != "sticks":
        return amount
    match axis:
        case "roll" | "pitch":
            full, dead_zone = contract.full_lean_deg, contract.lean_dead_zone
        case "yaw":
            full, dead_zone = contract.full_yaw_rate_degps, contract.yaw_dead_zone
        case "climb":
            full = contract.full_climb_mps if amount > 0.0 else contract.full_descent_mps
            dead_zone = contract.throttle_dead_zone
    beyond = max(0.0, abs(amount) - dead_zone) / (1.0 - dead_zone)
    return math.copysign(full * beyond, amount)
