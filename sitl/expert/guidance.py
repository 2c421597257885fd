"""Plans the path of least acceleration through the gates ahead.

Between waypoints a path of least integrated squared acceleration is a cubic in time (Bryson and Ho,
Applied Optimal Control, 1975). A waypoint is soft: missing its point or its velocity has a cost. So
the path, and with it the acceleration at its start, changes smoothly as one waypoint is passed and
another is added at the far end; with hard waypoints the gain would grow as 1 / time^2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sitl.rotation import Vec3

FloatArray = NDArray[np.float64]

POINT_WEIGHT_PER_S3 = 60.0
"""A waypoint has an effect until about (3 / weight)^(1/3) = 0.37 s before it is passed."""
VELOCITY_WEIGHT_PER_S = 2.0
FADE_S = 0.6
MIN_LEG_S = 0.03


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """Wanted position and velocity ``leg_s`` after the previous waypoint."""

    point_m: Vec3
    velocity_mps: Vec3
    leg_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Plan:
    """Accelerations and velocities at the start of the path and at its waypoints."""

    accel_mps2: FloatArray  # [N + 1, 3]
    velocity_mps: FloatArray  # [N + 1, 3]


def least_acceleration(position_m: Vec3, velocity_mps: Vec3, waypoints: Sequence[Waypoint]) -> Plan:
    """Plan from a position and velocity through the waypoints, in any inertial frame."""
    count = len(waypoints)
    hessian = np.zeros((2 * count + 2, 2 * count + 2))
    target = np.zeros((2 * count + 2, 3))
    legs_s = [max(waypoint.leg_s, MIN_LEG_S) for waypoint in waypoints]
    ahead_s = 0.0
    for k, (waypoint, leg_s) in enumerate(zip(waypoints, legs_s, strict=True)):
        first = 2 * k
        ahead_s += leg_s
        hessian[first : first + 4, first : first + 4] += _leg_cost(leg_s)
        hessian[first + 2, first + 2] += POINT_WEIGHT_PER_S3
        # A velocity wanted at one instant is a step in acceleration there: fade it in.
        weight = VELOCITY_WEIGHT_PER_S * min(1.0, ahead_s / FADE_S)
        hessian[first + 3, first + 3] += weight
        target[first + 2] += POINT_WEIGHT_PER_S3 * np.array(waypoint.point_m)
        target[first + 3] += weight * np.array(waypoint.velocity_mps)
    start = np.array([position_m, velocity_mps])
    states = np.linalg.solve(hessian[2:, 2:], target[2:] - hessian[2:, :2] @ start)
    points = np.concatenate([start, states])
    position, velocity = points[0::2], points[1::2]
    accel = np.empty_like(position)
    for k, leg_s in enumerate(legs_s):
        mean = (position[k + 1] - position[k]) / leg_s
        accel[k] = (6 * mean - 4 * velocity[k] - 2 * velocity[k + 1]) / leg_s
    accel[count] = (-6 * mean + 2 * velocity[count - 1] + 4 * velocity[count]) / leg_s
    return Plan(accel_mps2=accel, velocity_mps=velocity)


def _leg_cost(leg_s: float) -> FloatArray:
    """Integral of the squared acceleration of a cubic, over (p0, v0, p1, v1)."""
    a, b, c = 12 / leg_s**3, 6 / leg_s**2, 2 / leg_s
    return np.array([[a, b, -a, b], [b, 2 * c, -b, c], [-a, -b, a, -b], [b, c, -b, 2 * c]])
