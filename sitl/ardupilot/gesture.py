"""Arming by the rudder: ArduCopter's ARMING_RUDDER 2, its default."""

from typing import Literal

from sitl.ardupilot.sticks import Sticks
from sitl.clock import NS_PER_S

HOLD_NS = 2 * NS_PER_S
"""ArduCopter's ARM_DELAY and DISARM_DELAY of the sticks."""
FULL_YAW = 4000 / 4500


class RudderGesture:
    """Throttle at its end with full yaw: to the right arms, to the left disarms."""

    def __init__(self) -> None:
        self._side = 0
        self._since_ns: int | None = None

    def update(self, sticks: Sticks, now_ns: int) -> Literal["arm", "disarm"] | None:
        """The gesture, once, when it has been held for long enough."""
        side = 0
        if sticks.throttle == 0.0 and abs(sticks.yaw) > FULL_YAW:
            side = 1 if sticks.yaw > 0.0 else -1
        if side != self._side:
            self._side, self._since_ns = side, now_ns
        if side == 0 or self._since_ns is None or now_ns - self._since_ns < HOLD_NS:
            return None
        self._since_ns = None
        return "arm" if side > 0 else "disarm"
