"""Guidance over a gate course: from a predicted state to the wanted motion.

The demand follows from position, velocity, the next gate and the two after it, all of which a
policy could see or have as input; the only memory is the index of the next gate. The guide plans
the path of least acceleration through the gates ahead, and slows down where the path would exceed
the vehicle's ``Agility``. After a miss it backs off, nose towards the gate, and tries again. After
the last gate it brakes and hovers.

Horizontal vectors are complex numbers, north + 1j * east. A product with the conjugate of a unit
vector has the component along it as its real part and the one to its right as its imaginary part.
"""

import cmath
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl import UsageError
from sitl.course import Course, Gate, GateCounter, crossing
from sitl.vehicle.dynamics import clamp
from sitl.vehicle.rotation import Vec3, horizontal, length, plus, wrap_pi

FloatArray = NDArray[np.float64]

GATES_AHEAD = 3
SPEED_GAIN_PER_S = 1.5
MIN_SPEED_MPS = 1.5
LOOK_M = 5.0  # the nose points at the next gate; once nearer, along the leg after it
YAW_GAIN_PER_S = 2.5
MAX_YAW_RATE_RADPS = math.radians(110.0)
TAKEOFF_HEIGHT_M = (0.4, 1.4)
"""Below the first height it only climbs, above the second it flies at full speed."""
BACKING_SPEED_MPS = 2.5
CLEAR_OF_FRAME_M = 2.4  # sideways from a gate's axis, the vehicle's size included
MISS_M = (0.7, 1.2)
"""Predicted miss distance in the plane of a gate, despite full lean: from the first value on it
starts to back off, from the second on it only backs off."""
BRAKING_GAIN_PER_S = 1.2
BEYOND_LEG_M = 8.0

POINT_WEIGHT_PER_S3 = 60.0
"""A waypoint has an effect until about (3 / weight)^(1/3) = 0.37 s before it is passed."""
VELOCITY_WEIGHT_PER_S = 2.0
FADE_S = 0.6
MIN_LEG_S = 0.03


class Demand(NamedTuple):
    """Motion that the actions must produce."""

    accel_mps2: complex  # horizontal, north + 1j * east
    climb_mps: float
    yaw_rate_radps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Agility:
    """Limits of the demanded motion; accelerations are horizontal unless noted."""

    max_speed_mps: float
    max_accel_mps2: float
    corner_accel_mps2: float
    """Acceleration at which the planned path slows down; the rest is for gusts and mistakes."""
    along_accel_mps2: tuple[float, float]  # (braking, negative; speeding up)
    planned_braking_mps2: float
    planned_accel_mps2: float
    climb_accel_mps2: float  # vertical; assumed available for reaching a gate's opening
    climb_lead_s: float  # lead of the demanded climb rate over the planned one
    takeoff_climb_mps: float
    braking_distance_m: float  # beyond the last gate, until full braking


class CourseGuide:
    """Guidance of one flight over a course; call `demand` at 50 Hz or more.

    ``speed_mps`` is the speed where the course allows it; at 8 m/s by sticks it slows down for
    corners.

    Raises:
        UsageError: a speed that cannot be flown.
    """

    def __init__(
        self, course: Course, agility: Agility, speed_mps: float, next_gate: int = 0
    ) -> None:
        if not MIN_SPEED_MPS <= speed_mps <= agility.max_speed_mps:
            raise UsageError(
                f"the expert flies at {MIN_SPEED_MPS} to {agility.max_speed_mps} m/s, "
                f"got {speed_mps}"
            )
        self._course = course
        self._last = course.gates[-1]
        # Points straight ahead of the last gate, so that it is flown like any other.
        step_m = cmath.rect(BEYOND_LEG_M, self._last.yaw_rad)
        leg_ned_m = (step_m.real, step_m.imag, 0.0)
        self._beyond = tuple(
            replace(self._last, center_ned_m=plus(self._last.center_ned_m, leg_ned_m, k))
            for k in range(1, GATES_AHEAD + 1)
        )
        self._agility = agility
        self._speed_mps = speed_mps
        self._referee = GateCounter(course, first=next_gate)

    @property
    def next_gate(self) -> int | None:
        return self._referee.next_gate

    def demand(self, position_ned_m: Vec3, t_s: float, state: "Predicted") -> Demand:
        """Return the demand for a vehicle here now, and in ``state`` when its action takes effect.

        The positions of successive calls are the flown trajectory.
        """
        agility = self._agility
        self._referee.update(position_ned_m, t_s)
        ahead = self._gates_ahead(position_ned_m, state)
        demand = _approach(state, ahead[:GATES_AHEAD], agility, self._speed_mps)
        if len(ahead) <= GATES_AHEAD:
            beyond_m, _, _ = self._last.offset_m(state.position_ned_m)
            share = _smoothstep(beyond_m, 0.0, agility.braking_distance_m)
            demand = _blend(demand, _brake(state, agility), share)
        elif (share := _back_off_share(state, ahead[0], agility)) > 0.0:
            demand = _blend(demand, _back_off(state, ahead[0], agility), share)
        climb_away = Demand(
            _brake(state, agility).accel_mps2, agility.takeoff_climb_mps, demand.yaw_rate_radps
        )
        flying = _smoothstep(-state.position_ned_m[2], *TAKEOFF_HEIGHT_M)
        return _blend(climb_away, demand, flying)

    def _gates_ahead(self, position_ned_m: Vec3, state: "Predicted") -> tuple[Gate, ...]:
        """Return the gates ahead, without one that is passed before the action takes effect."""
        if (passed := self.next_gate) is None:
            return self._beyond
        left = self._course.passages - passed
        ahead = self._course.ahead(passed, min(left, GATES_AHEAD + 1)) + self._beyond
        is_passing = crossing(ahead[0], position_ned_m, state.position_ned_m) is not None
        return ahead[1:] if is_passing else ahead


@dataclass(frozen=True, slots=True, kw_only=True)
class Predicted:
    """Predicted state when an action sent now takes effect, if nothing changes until then."""

    position_ned_m: Vec3
    velocity_ned_mps: Vec3
    yaw_rad: float

    @property
    def velocity_mps(self) -> complex:
        return horizontal(self.velocity_ned_mps)


@dataclass(frozen=True, slots=True, kw_only=True)
class Waypoint:
    """Wanted position and velocity ``leg_s`` after the previous waypoint."""

    point_m: Vec3
    velocity_mps: Vec3
    leg_s: float


def least_acceleration(
    position_m: Vec3, velocity_mps: Vec3, waypoints: Sequence[Waypoint]
) -> FloatArray:
    """Plan from a position and velocity through the waypoints, in any inertial frame.

    Return the accelerations at the start of the path and at its waypoints, [N + 1, 3].

    Between waypoints, a path of least integrated squared acceleration is a cubic in time (Bryson
    and Ho, Applied Optimal Control, 1975). Waypoints are soft: missing a point or its velocity has
    a cost. The path, and so the acceleration at its start, therefore changes smoothly when one
    waypoint is passed and another is added at the far end. With hard waypoints the gain would grow
    as 1 / time^2.
    """
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
        # A velocity demanded at one instant is a step in acceleration there: fade it in.
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
    return accel


def _leg_cost(leg_s: float) -> FloatArray:
    """Return the integral of the squared acceleration of a cubic, over (p0, v0, p1, v1)."""
    a, b, c = 12 / leg_s**3, 6 / leg_s**2, 2 / leg_s
    return np.array([[a, b, -a, b], [b, 2 * c, -b, c], [-a, -b, a, -b], [b, c, -b, 2 * c]])


def _approach(
    state: Predicted, ahead: tuple[Gate, ...], agility: Agility, speed_mps: float
) -> Demand:
    """Return the demand along the path through the gates ahead, at the speed that it allows."""
    velocity = state.velocity_mps
    to_aim_m = _aim_point(state, ahead) - horizontal(state.position_ned_m)
    distance_m = max(length(to_aim_m), 1e-3)
    sight = to_aim_m / distance_m
    closing_mps = max(MIN_SPEED_MPS, (velocity * sight.conjugate()).real)
    waypoints = _waypoints(state, ahead, closing_mps, agility, speed_mps)
    accel_mps2 = least_acceleration(state.position_ned_m, state.velocity_ned_mps, waypoints)
    accel_n, accel_e, accel_d = accel_mps2[0].tolist()
    # Speed along the path is controlled; the plan's speed only serves its timing.
    along = velocity + MIN_SPEED_MPS * sight
    along /= max(length(along), 1e-3)
    right_mps2 = clamp((complex(accel_n, accel_e) * along.conjugate()).imag, agility.max_accel_mps2)
    allowed_mps = min(
        speed_mps,
        closing_mps * _corner_ratio(right_mps2, agility),
        _corner_speed(accel_mps2, waypoints, agility),
    )
    error_mps = max(MIN_SPEED_MPS, allowed_mps) - (velocity * along.conjugate()).real
    low, high = agility.along_accel_mps2
    room = math.sqrt(agility.max_accel_mps2**2 - right_mps2**2)
    along_mps2 = clamp(max(low, min(high, SPEED_GAIN_PER_S * error_mps)), room)
    turning_radps = (velocity.conjugate() * sight).imag / max(distance_m, LOOK_M / 2)
    return Demand(
        accel_mps2=complex(along_mps2, right_mps2) * along,
        climb_mps=-(state.velocity_ned_mps[2] + agility.climb_lead_s * accel_d),
        yaw_rate_radps=_yaw_rate(cmath.phase(sight) - state.yaw_rad, turning_radps),
    )


def _aim_point(state: Predicted, ahead: tuple[Gate, ...]) -> complex:
    """Return the next gate; nearer than ``LOOK_M``, a point that slides along the leg after it."""
    gate = ahead[0]
    forward_m, _, _ = gate.offset_m(state.position_ned_m)
    center, leg, leg_m = horizontal(gate.center_ned_m), cmath.rect(1.0, gate.yaw_rad), 1.0
    if len(ahead) > 1:
        leg = horizontal(ahead[1].center_ned_m) - center
        leg_m = math.dist(ahead[1].center_ned_m, gate.center_ned_m)
    return center + max(0.0, LOOK_M + forward_m) / leg_m * leg


def _waypoints(
    state: Predicted,
    ahead: tuple[Gate, ...],
    closing_mps: float,
    agility: Agility,
    speed_mps: float,
) -> list[Waypoint]:
    """Return the gates as waypoints; each leg is timed by the speed reachable half-way along it."""
    waypoints = []
    before, covered_m = state.position_ned_m, 0.0
    for gate in ahead:
        # Off the axis, the distance does not vanish in the plane of the gate; the time must.
        forward_m, right_m, _ = gate.offset_m(before)
        leg_m = math.hypot(min(0.0, forward_m), max(0.0, abs(right_m) - gate.size_m / 2))
        gained = 2 * agility.planned_accel_mps2 * (covered_m + leg_m / 2)
        pace_mps = min(max(closing_mps, speed_mps), math.sqrt(closing_mps**2 + gained))
        through = cmath.rect(pace_mps, gate.yaw_rad)
        waypoints.append(
            Waypoint(
                point_m=gate.center_ned_m,
                velocity_mps=(through.real, through.imag, 0.0),
                leg_s=leg_m / pace_mps,
            )
        )
        before, covered_m = gate.center_ned_m, covered_m + leg_m
    return waypoints


def _corner_speed(accel_mps2: FloatArray, waypoints: list[Waypoint], agility: Agility) -> float:
    """Return the speed from which the vehicle can still slow down for the corners ahead."""
    allowed_mps, distance_m = math.inf, 0.0
    for waypoint, accel in zip(waypoints, accel_mps2[1:].tolist(), strict=True):
        timed_mps = math.hypot(*waypoint.velocity_mps)
        distance_m += waypoint.leg_s * timed_mps
        corner_mps = timed_mps * _corner_ratio(math.hypot(*accel[:2]), agility)
        braking = 2 * agility.planned_braking_mps2 * distance_m
        allowed_mps = min(allowed_mps, math.sqrt(corner_mps**2 + braking))
    return allowed_mps


def _corner_ratio(accel_mps2: float, agility: Agility) -> float:
    """Return the factor by which a corner with this lateral acceleration can be flown faster."""
    return math.sqrt(agility.corner_accel_mps2 / max(abs(accel_mps2), 1e-3))


def _back_off_share(state: Predicted, gate: Gate, agility: Agility) -> float:
    """Return 0 if the gate can be flown from here; up to 1 if the vehicle is beside or behind it,
    or too fast and too far off to reach the opening."""
    forward_m, right_m, down_m = gate.offset_m(state.position_ned_m)
    if forward_m >= 0.0:
        return 1.0
    reach_m = gate.size_m / 2 + 0.2 - 0.8 * forward_m
    beside = _smoothstep(abs(right_m) - reach_m, 0.0, 1.5)
    forward_mps, rightward_mps, downward_mps = gate.to_axes(state.velocity_ned_mps)
    left_s = -forward_m / max(forward_mps, MIN_SPEED_MPS)
    right_miss_m = abs(right_m + rightward_mps * left_s) - agility.max_accel_mps2 * left_s**2 / 2
    down_miss_m = abs(down_m + downward_mps * left_s) - agility.climb_accel_mps2 * left_s**2 / 2
    return max(beside, _smoothstep(max(right_miss_m, down_miss_m), *MISS_M))


def _back_off(state: Predicted, gate: Gate, agility: Agility) -> Demand:
    """Return the demand to fly backwards beside the gate, nose along its passage, to its front."""
    forward_m, right_m, down_m = gate.offset_m(state.position_ned_m)
    is_beside = forward_m > -1.0 and abs(right_m) < CLEAR_OF_FRAME_M
    side_m = math.copysign(CLEAR_OF_FRAME_M, right_m) if is_beside else right_m
    across_mps = clamp(side_m - right_m, 2.0)
    wanted_mps = complex(-BACKING_SPEED_MPS, across_mps) * cmath.rect(1.0, gate.yaw_rad)
    accel = SPEED_GAIN_PER_S * (wanted_mps - state.velocity_mps)
    return Demand(
        accel_mps2=min(1.0, -agility.along_accel_mps2[0] / max(1e-6, length(accel))) * accel,
        climb_mps=0.0 if is_beside else clamp(down_m, 1.0),
        yaw_rate_radps=_yaw_rate(gate.yaw_rad - state.yaw_rad, 0.0),
    )


def _brake(state: Predicted, agility: Agility) -> Demand:
    most_mps = -agility.along_accel_mps2[0] / BRAKING_GAIN_PER_S
    gain = BRAKING_GAIN_PER_S * min(1.0, most_mps / max(1e-6, length(state.velocity_mps)))
    return Demand(-gain * state.velocity_mps, 0.0, 0.0)


def _yaw_rate(error_rad: float, lead_radps: float) -> float:
    rate_radps = YAW_GAIN_PER_S * wrap_pi(error_rad) + lead_radps
    return MAX_YAW_RATE_RADPS * math.tanh(rate_radps / MAX_YAW_RATE_RADPS)


def _blend(a: Demand, b: Demand, share: float) -> Demand:
    return Demand(
        accel_mps2=a.accel_mps2 + share * (b.accel_mps2 - a.accel_mps2),
        climb_mps=a.climb_mps + share * (b.climb_mps - a.climb_mps),
        yaw_rate_radps=a.yaw_rate_radps + share * (b.yaw_rate_radps - a.yaw_rate_radps),
    )


def _smoothstep(value: float, low: float, high: float) -> float:
    fraction = max(0.0, min(1.0, (value - low) / (high - low)))
    return fraction * fraction * (3.0 - 2.0 * fraction)
