"""Vehicles whose sticks are mapped in tests, and their motion by independent formulas."""

import math
from typing import NamedTuple

from mavbridge.core.vehicle import StickGains, Sticks
from mavbridge.mavlink.profiles.ardupilot_sticks import calibration
from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.rc import RcEngine, climb_rate_mps, lean_angles, read_sticks, yaw_rate_radps
from sitl.vehicle.conditions import Conditions
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.firmware import Receiver

PX4_DEFAULTS = {
    "MPC_MAN_TILT_MAX": 35.0,
    "MAN_DEADZONE": 0.1,
    "MPC_MAN_Y_MAX": 150.0,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
}
"""Parameters of the PX4 whose curves were measured."""


class Motion(NamedTuple):
    """Leans in degrees (+ nose down, + right side down), yaw rate in degrees/s, climb in m/s."""

    climb_mps: float
    yaw_degps: float
    pitch_deg: float
    roll_deg: float


def policy_motion(sticks: Sticks, gains: StickGains) -> Motion:

    def linear(stick: float, dead_zone: float) -> float:
        beyond = max(0.0, abs(stick) - dead_zone) / (1.0 - dead_zone)
        return math.copysign(beyond, stick)

    climb = linear(sticks.throttle, gains.throttle_dead_zone)
    pitch = linear(sticks.pitch, gains.lean_dead_zone)
    roll = linear(sticks.roll, gains.lean_dead_zone)
    lean_deg = gains.lean_deg / max(1.0, math.hypot(pitch, roll))
    return Motion(
        climb_mps=climb * (gains.climb_mps if climb > 0.0 else gains.descent_mps),
        yaw_degps=linear(sticks.yaw, gains.yaw_dead_zone) * gains.yaw_rate_degps,
        pitch_deg=pitch * lean_deg,
        roll_deg=roll * lean_deg,
    )


def copter_values(**changed: float) -> dict[str, float]:
    params = ArduPilotParams()
    return {name: params[name] for name in params.names} | changed


def copter_motion(sticks: Sticks, conditions: Conditions) -> Motion:
    """Return the motion of the simulated copter's own code for these sticks, as PWM on the wire."""
    params = ArduPilotParams(VehicleConfig(conditions=conditions))
    channels = calibration({name: params[name] for name in params.names})
    rc = RcEngine(params, Receiver(None))
    for channel, pwm_us in zip(channels.channels, channels.to_pwm_us(sticks), strict=True):
        rc.channels_us[channel.number - 1] = pwm_us
    read = read_sticks(rc, params)
    roll_rad, pitch_rad = lean_angles(read, params)
    return Motion(
        climb_mps=climb_rate_mps(read, params),
        yaw_degps=math.degrees(yaw_rate_radps(read, params)),
        pitch_deg=-math.degrees(pitch_rad),
        roll_deg=math.degrees(roll_rad),
    )


def px4_motion(sticks: Sticks, values: dict[str, float]) -> Motion:
    """Return PX4's motion for these sticks, by its formulas."""

    def shaped(stick: float, name: str) -> float:
        dead_zone, expo = values["MAN_DEADZONE"], values.get(name, 0.6)
        beyond = max(0.0, abs(stick) - dead_zone) / (1.0 - dead_zone)
        return math.copysign((1.0 - expo) * beyond + expo * beyond**3, stick)

    length = max(1.0, math.hypot(sticks.pitch, sticks.roll))
    tilt_deg = values["MPC_MAN_TILT_MAX"]

    def lean_deg(stick: float) -> float:
        return math.degrees(math.atan(stick / length * math.tan(math.radians(tilt_deg))))

    climb = shaped(sticks.throttle, "MPC_Z_MAN_EXPO")
    full_mps = values["MPC_Z_VEL_MAX_UP" if climb > 0.0 else "MPC_Z_VEL_MAX_DN"]
    return Motion(
        climb_mps=climb * full_mps,
        yaw_degps=shaped(sticks.yaw, "MPC_YAW_EXPO") * values["MPC_MAN_Y_MAX"],
        pitch_deg=lean_deg(sticks.pitch),
        roll_deg=lean_deg(sticks.roll),
    )
