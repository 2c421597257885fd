"""Simple and Super Simple mode: pitch and roll sticks count in other axes than the vehicle's.

As Copter up to 4.6 and from 4.8 on has them; 4.7.0 switches them and turns nothing. They stay as
they are until a switch or a command changes them: a parameter alone does nothing.
"""

import math
from collections.abc import Sequence
from enum import IntEnum

from sitl.ardupilot.params import RC_CHANNELS_WITH_PARAMS, Params
from sitl.ardupilot.sticks import Sticks
from sitl.rotation import Vec3

_OPTION_SIMPLE, _OPTION_SUPER_SIMPLE = 3, 13
_LOW_US, _HIGH_US = 1200, 1800
_SUPER_SIMPLE_RADIUS_M = 10.0


class Axes(IntEnum):
    """Those in which the sticks count."""

    VEHICLE = 0
    ARMING = 1
    HOME = 2


class SimpleMode:
    """The axes, and the yaw of those in radians."""

    def __init__(self, params: Params) -> None:
        self._params = params
        self.axes = Axes.VEHICLE
        self._arming_rad = self._home_rad = 0.0
        self._aux: Axes | None = None

    def arm(self, yaw_rad: float) -> None:
        """Remember the heading at arming."""
        self._arming_rad = self._home_rad = yaw_rad

    def read_mode_switch(self, position: int) -> None:
        """The mode switch has moved to this position, 1 to 6, or was read for the first time."""
        if self._aux is None:
            bit = 1 << (position - 1)
            is_super = self._params.integer("SUPER_SIMPLE") & bit
            is_simple = self._params.integer("SIMPLE") & bit
            self.axes = Axes.HOME if is_super else Axes.ARMING if is_simple else Axes.VEHICLE

    def read_aux(self, channels_us: Sequence[int]) -> None:
        """Follow the movements of a switch with RCn_OPTION 3 or 13."""
        before, self._aux = self._aux, None
        for index in range(RC_CHANNELS_WITH_PARAMS):
            option, pwm_us = self._params.integer(f"RC{index + 1}_OPTION"), channels_us[index]
            if option in (_OPTION_SIMPLE, _OPTION_SUPER_SIMPLE) and pwm_us:
                high = Axes.HOME if option == _OPTION_SUPER_SIMPLE else Axes.ARMING
                is_low = pwm_us < _LOW_US
                self._aux = Axes.VEHICLE if is_low else high if pwm_us > _HIGH_US else Axes.ARMING
        if self._aux is not None and self._aux is not before:
            self.axes = self._aux

    def turned(self, sticks: Sticks, yaw_rad: float, position_ned_m: Vec3) -> Sticks:
        """The same sticks in the vehicle's own axes."""
        if self.axes is Axes.VEHICLE:
            return sticks
        north_m, east_m, _ = position_ned_m
        if math.hypot(north_m, east_m) > _SUPER_SIMPLE_RADIUS_M:
            self._home_rad = math.atan2(east_m, north_m)
        angle_rad = self._home_rad if self.axes is Axes.HOME else self._arming_rad
        cos, sin = math.cos(angle_rad - yaw_rad), math.sin(angle_rad - yaw_rad)
        forward, right = -sticks.pitch, sticks.roll
        return sticks._replace(
            pitch=-(cos * forward - sin * right), roll=sin * forward + cos * right
        )
