"""Setpoints of OFFBOARD: what a companion computer has asked for, and when."""

from typing import NamedTuple, TypeAlias

from sitl.rotation import Quat, Vec3


class AttitudeSetpoint(NamedTuple):
    """SET_ATTITUDE_TARGET with an attitude."""

    ned_from_body_wxyz: Quat
    yaw_rate_radps: float
    thrust: float  # collective, 0..1


class RateSetpoint(NamedTuple):
    """SET_ATTITUDE_TARGET with body rates."""

    rate_body_radps: Vec3
    thrust: float


class VelocitySetpoint(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED; None where the sender ignores the field."""

    position_ned_m: Vec3 | None
    velocity_ned_mps: Vec3 | None
    yaw_rad: float | None
    yaw_rate_radps: float


Setpoint: TypeAlias = AttitudeSetpoint | RateSetpoint | VelocitySetpoint
