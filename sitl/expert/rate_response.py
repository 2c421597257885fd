"""From a demanded motion to the collective thrust and body rates that bring it about."""

import math
from typing import NamedTuple

from sitl.expert.course_guide import Demand, Predicted
from sitl.rotation import Quat, Vec3, conjugate, rotate
from sitl.vehicle.control import clamp
from sitl.vehicle.dynamics import GRAVITY_MPS2

HOVER_THRUST = 0.39
TILT_GAIN_PER_S = 8.0
CLIMB_GAIN_PER_S = 4.0
MAX_TILT_RAD = math.radians(62.0)
FORCE_MPS2 = (3.0, 21.0)
"""Least and most specific force."""
MAX_RATE_RADPS = math.radians(200.0)
MAX_YAW_RATE_RADPS = math.radians(115.0)


class RateCommand(NamedTuple):
    """Collective thrust and body rates, in FRD axes and the order of the action vector."""

    thrust: float
    """In [0, 1]; ``HOVER_THRUST`` hovers."""
    roll_radps: float
    pitch_radps: float
    yaw_radps: float


def rate_command(
    demand: Demand, state: Predicted, ned_from_body: Quat, drag_ned_mps2: Vec3
) -> RateCommand:
    """Thrust and rates for a demand, in a predicted state and attitude, against this drag.

    The thrust points where the demand needs it, turned there the shorter way round. The tilt has a
    loop of its own, and the heading follows by its rate alone: the thrust's direction matters more
    than where the nose points (Brescianini and D'Andrea, "Tilt-Prioritized Quadrocopter Attitude
    Control", 2018).
    """
    force_ned = _specific_force(demand, state, drag_ned_mps2)
    size = math.hypot(*force_ned)
    body_from_ned = conjugate(ned_from_body)
    x, y, z = (part / size for part in rotate(body_from_ned, force_ned))
    # The rotation vector that takes the thrust, along -z of the body, to the force.
    sine = math.hypot(x, y)
    angle_rad = math.atan2(sine, -z)
    per_sine = TILT_GAIN_PER_S * angle_rad / sine if sine > 1e-6 else TILT_GAIN_PER_S
    turn = tuple(demand.yaw_rate_radps * down for down in rotate(body_from_ned, (0, 0, 1.0)))
    return RateCommand(
        thrust=HOVER_THRUST * size * max(0.2, -z) / GRAVITY_MPS2,
        roll_radps=clamp(per_sine * y + turn[0], MAX_RATE_RADPS),
        pitch_radps=clamp(-per_sine * x + turn[1], MAX_RATE_RADPS),
        yaw_radps=clamp(turn[2], MAX_YAW_RATE_RADPS),
    )


def _specific_force(demand: Demand, state: Predicted, drag_ned_mps2: Vec3) -> Vec3:
    """Specific force of the thrust in NED, with a bounded tilt and size."""
    drag_n, drag_e, drag_d = drag_ned_mps2
    north = demand.accel_mps2.real - drag_n
    east = demand.accel_mps2.imag - drag_e
    climb_error_mps = demand.climb_mps + state.velocity_ned_mps[2]
    up = GRAVITY_MPS2 + CLIMB_GAIN_PER_S * climb_error_mps + drag_d
    up = max(FORCE_MPS2[0], min(FORCE_MPS2[1], up))
    level = math.hypot(north, east)
    most = min(up * math.tan(MAX_TILT_RAD), math.sqrt(max(FORCE_MPS2[1] ** 2 - up**2, 1.0)))
    scale = min(1.0, most / max(level, 1e-6))
    return (scale * north, scale * east, -up)
