"""Stick curves: dead zone and expo of climb, yaw and speed; leans; manual thrust.

As measured: 0.4 x + 0.6 x^3 behind a dead zone of MAN_DEADZONE on climb, yaw and POSCTL's speed;
leans without a dead zone, in ALTCTL by the tangent, in STAB by the angle.
"""

import math

from sitl.px4.params import Px4Params
from sitl.px4.sticks import Sticks
from sitl.rotation import Vec3
from sitl.vehicle.dynamics import GRAVITY_MPS2

EXPO = 0.6


def curve(value: float, dead_zone: float, expo: float = EXPO) -> float:
    """A stick in [-1, 1] behind dead zone and expo."""
    beyond = max(0.0, abs(value) - dead_zone) / (1.0 - dead_zone)
    return math.copysign((1.0 - expo) * beyond + expo * beyond**3, value)


def climb_mps(sticks: Sticks, params: Px4Params) -> float:
    """Climb rate of ALTCTL and POSCTL, + up."""
    share = curve(sticks.throttle, params.dead_zone, params.get("MPC_Z_MAN_EXPO", EXPO))
    return share * params["MPC_Z_VEL_MAX_UP" if share > 0.0 else "MPC_Z_VEL_MAX_DN"]


def yaw_rate_radps(sticks: Sticks, params: Px4Params) -> float:
    """Yaw rate of every mode but ACRO."""
    share = curve(sticks.yaw, params.dead_zone, params.get("MPC_YAW_EXPO", EXPO))
    return math.radians(params["MPC_MAN_Y_MAX"]) * share


def lean_accel_mps2(sticks: Sticks, params: Px4Params) -> tuple[float, float]:
    """Forward and right acceleration of ALTCTL's lean; both sticks share MPC_MAN_TILT_MAX."""
    scale = GRAVITY_MPS2 * math.tan(math.radians(params["MPC_MAN_TILT_MAX"]))
    scale /= max(1.0, math.hypot(sticks.forward, sticks.right))
    return sticks.forward * scale, sticks.right * scale


def lean_rad(sticks: Sticks, params: Px4Params) -> tuple[float, float]:
    """Roll and pitch (+ nose up) of STAB; both sticks share MPC_MAN_TILT_MAX."""
    scale = math.radians(params["MPC_MAN_TILT_MAX"])
    scale /= max(1.0, math.hypot(sticks.forward, sticks.right))
    return sticks.right * scale, -sticks.forward * scale


def acro_rates_radps(sticks: Sticks, params: Px4Params) -> Vec3:
    """Body rates of ACRO, linear."""
    return (
        math.radians(params["MC_ACRO_R_MAX"]) * sticks.right,
        -math.radians(params["MC_ACRO_P_MAX"]) * sticks.forward,
        math.radians(params["MC_ACRO_Y_MAX"]) * sticks.yaw,
    )


def speed_mps(sticks: Sticks, params: Px4Params) -> tuple[float, float]:
    """Forward and right speed that POSCTL ends up at; both sticks share MPC_VEL_MANUAL."""
    length = math.hypot(sticks.forward, sticks.right)
    if length == 0.0:
        return 0.0, 0.0
    speed = params["MPC_VEL_MANUAL"] * curve(min(1.0, length), params.dead_zone)
    return speed * sticks.forward / length, speed * sticks.right / length


def manual_thrust(sticks: Sticks, params: Px4Params, hover: float) -> float:
    """Collective of STAB and ACRO: straight lines through hover thrust at mid-stick."""
    if sticks.throttle < 0.0:
        least = params["MPC_MANTHR_MIN"]
        return least + (1.0 + sticks.throttle) * (hover - least)
    return hover + sticks.throttle * (params["MPC_THR_MAX"] - hover)
