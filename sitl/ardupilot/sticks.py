"""Stick processing: dead zones, curves, the arming gesture.

Formulas: ArduPilot ``RC_Channel`` (calibration), Copter ``get_pilot_desired_throttle`` and
``get_pilot_desired_climb_rate``; checked against leans and rates measured on the firmware.
"""

import math
from typing import NamedTuple

from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.rc import RcEngine
from sitl.clock import NS_PER_S

THROTTLE_FULL = 1000.0
GESTURE_NS = 2 * NS_PER_S  # hold time: ArduCopter's ARM_DELAY and DISARM_DELAY of the sticks
FULL_YAW = 4000 / 4500


class Sticks(NamedTuple):
    """Stick positions after calibration and dead zone."""

    roll: float  # [-1, 1], + right
    pitch: float  # [-1, 1], + stick back, nose up: the sign of the raw channel, not of a joystick
    yaw: float  # [-1, 1], + nose right
    throttle: float  # [0, 1000] from stick down to stick up
    throttle_mid: float  # middle of the throttle's travel on that scale


def read_sticks(rc: RcEngine, params: ArduPilotParams) -> Sticks:
    """Return the four flight sticks by RCMAP_*; a channel that never had a value is centred."""
    throttle, mid = _throttle(rc, params)
    return Sticks(
        roll=_centred(rc, params, "ROLL"),
        pitch=_centred(rc, params, "PITCH"),
        yaw=_centred(rc, params, "YAW"),
        throttle=throttle,
        throttle_mid=mid,
    )


def _centred(rc: RcEngine, params: ArduPilotParams, axis: str) -> float:
    index = rc.index_of(axis)
    pwm = rc.channels_us[index]
    name = f"RC{index + 1}_"
    trim, dead_zone = params[name + "TRIM"], params[name + "DZ"]
    if pwm == 0:
        return 0.0
    if pwm > trim + dead_zone:
        offset, span = pwm - trim - dead_zone, params[name + "MAX"] - trim - dead_zone
    elif pwm < trim - dead_zone:
        offset, span = pwm - trim + dead_zone, trim - dead_zone - params[name + "MIN"]
    else:
        return 0.0
    value = max(-1.0, min(1.0, offset / span)) if span > 0.0 else 0.0
    return -value if params[name + "REVERSED"] else value


def _throttle(rc: RcEngine, params: ArduPilotParams) -> tuple[float, float]:
    """Return the throttle and its middle, in 0..THROTTLE_FULL."""
    index = rc.index_of("THROTTLE")
    name = f"RC{index + 1}_"
    low, high = params[name + "MIN"], params[name + "MAX"]
    bottom = low + params[name + "DZ"]
    if high <= bottom:
        return 0.0, THROTTLE_FULL / 2.0
    scale = THROTTLE_FULL / (high - bottom)
    mid = max(0.0, ((low + high) / 2.0 - bottom) * scale)
    if rc.channels_us[index] == 0:
        return 0.0, mid
    pwm = max(low, min(high, float(rc.channels_us[index])))
    if params[name + "REVERSED"]:
        pwm = low + high - pwm
    return max(0.0, (pwm - bottom) * scale), mid


def lean_angles(sticks: Sticks, params: ArduPilotParams) -> tuple[float, float]:
    """Return roll and pitch [rad] (+ right, + nose up), their joint length limited to ANGLE_MAX."""
    limit = math.radians(params["ANGLE_MAX"] / 100.0)
    scale = limit / max(1.0, math.hypot(sticks.roll, sticks.pitch))
    return sticks.roll * scale, sticks.pitch * scale


def yaw_rate_radps(sticks: Sticks, params: ArduPilotParams) -> float:
    return math.radians(params["PILOT_Y_RATE"]) * _expo(sticks.yaw, params["PILOT_Y_EXPO"])


def acro_rates_radps(sticks: Sticks, params: ArduPilotParams) -> tuple[float, float, float]:
    """Return ACRO's body rates before the trainer; roll and pitch share a circle."""
    length = max(1.0, math.hypot(sticks.roll, sticks.pitch))
    full = math.radians(params["ACRO_RP_RATE"])
    expo = params["ACRO_RP_EXPO"]
    return (
        full * _expo(sticks.roll / length, expo),
        full * _expo(sticks.pitch / length, expo),
        sticks.yaw * math.radians(params["ACRO_Y_RATE"]),
    )


def _expo(value: float, expo: float) -> float:
    """Apply ArduPilot's ``input_expo``: softer around the middle, unchanged at the ends."""
    expo = max(0.0, min(0.95, expo))
    return (1.0 - expo) * value / (1.0 - expo * abs(value))


def climb_rate_mps(sticks: Sticks, params: ArduPilotParams) -> float:
    """Return the climb rate of ALT_HOLD, + up; 0 within THR_DZ of the middle."""
    dead_zone = max(0.0, min(400.0, params["THR_DZ"]))
    top = sticks.throttle_mid + dead_zone
    bottom = sticks.throttle_mid - dead_zone
    up = params["PILOT_SPEED_UP"] / 100.0
    if sticks.throttle > top:
        return up * (sticks.throttle - top) / (THROTTLE_FULL - top)
    if sticks.throttle < bottom:
        return (params["PILOT_SPEED_DN"] / 100.0 or up) * (sticks.throttle - bottom) / bottom
    return 0.0


def manual_thrust(sticks: Sticks, params: ArduPilotParams) -> float:
    """Return the collective in [0, 1] of STABILIZE and ACRO, with hover thrust at mid-stick."""
    mid = min(max(sticks.throttle_mid, 1.0), THROTTLE_FULL - 1.0)
    if sticks.throttle < mid:
        position = 0.5 * sticks.throttle / mid
    else:
        position = 0.5 + 0.5 * (sticks.throttle - mid) / (THROTTLE_FULL - mid)
    expo = max(-0.5, min(1.0, (0.5 - params["MOT_THST_HOVER"]) / 0.375))
    return max(0.0, min(1.0, position * (1.0 - expo) + expo * position**3))


def gesture_side(sticks: Sticks) -> int:
    """Return the side of the rudder gesture, throttle down and full yaw: 1 arms, -1 disarms."""
    if sticks.throttle != 0.0 or abs(sticks.yaw) <= FULL_YAW:
        return 0
    return 1 if sticks.yaw > 0.0 else -1
