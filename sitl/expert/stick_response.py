"""From a demanded acceleration, climb and turn to the sticks that ALT_HOLD turns into them."""

import cmath
import math
from typing import NamedTuple

from sitl.ardupilot.params import ArduPilotParams
from sitl.expert.course_guide import Demand
from sitl.vehicle.control import clamp
from sitl.vehicle.dynamics import GRAVITY_MPS2

DEAD_ZONE_SLOPE = 0.08
"""A dead zone is crossed within about this share of full scale: by a slope, not by a jump."""


class StickPositions(NamedTuple):
    """Stick positions in [-1, 1], in the order of the action vector."""

    throttle: float  # 0 = mid-stick, + up
    yaw: float  # + nose right
    pitch: float  # + stick forward, nose down
    roll: float  # + right


CENTRED = StickPositions(0.0, 0.0, 0.0, 0.0)


class StickResponse:
    """Inverse of the vehicle's ALT_HOLD stick curves."""

    def __init__(self, params: ArduPilotParams) -> None:
        self._lean_rad = math.radians(params["ANGLE_MAX"] / 100.0)
        self._yaw_radps = math.radians(params["PILOT_Y_RATE"])
        self._yaw_expo = params["PILOT_Y_EXPO"]
        self._climb_mps = params["PILOT_SPEED_UP"] / 100.0
        self._descent_mps = params["PILOT_SPEED_DN"] / 100.0 or self._climb_mps
        self._roll_dead = params["RC1_DZ"] / 500.0
        self._pitch_dead = params["RC2_DZ"] / 500.0
        self._yaw_dead = params["RC4_DZ"] / 500.0
        half = (1000.0 - params["RC3_DZ"]) / 2.0
        self._throttle_dead = 2.0 * params["THR_DZ"] * (half / 500.0) / 1000.0

    def sticks(self, demand: Demand, drag_mps2: complex, yaw_rad: float) -> StickPositions:
        """Leans by the ratio to gravity in heading axes, against this drag, rates by full scale."""
        accel_mps2 = demand.accel_mps2 - drag_mps2
        forward_right = accel_mps2 * cmath.rect(1.0, -yaw_rad) / GRAVITY_MPS2
        nose_down_rad = math.atan(forward_right.real)
        right_rad = math.atan(forward_right.imag * math.cos(nose_down_rad))
        full_mps = self._climb_mps if demand.climb_mps > 0.0 else self._descent_mps
        turn = demand.yaw_rate_radps / self._yaw_radps
        turn_input = turn / (1.0 - self._yaw_expo * (1.0 - abs(turn)))  # inverse of `input_expo`
        return StickPositions(
            throttle=_past_dead_zone(demand.climb_mps / full_mps, self._throttle_dead),
            yaw=_past_dead_zone(turn_input, self._yaw_dead),
            pitch=_past_dead_zone(nose_down_rad / self._lean_rad, self._pitch_dead),
            roll=_past_dead_zone(right_rad / self._lean_rad, self._roll_dead),
        )


def _past_dead_zone(value: float, dead: float) -> float:
    """The stick whose effect is ``value`` of full scale."""
    return clamp((1.0 - dead) * value + dead * math.tanh(value / DEAD_ZONE_SLOPE), 1.0)
