"""An expert that flies a gate course with sticks alone, in ALT_HOLD, from the true pose.

Its sticks follow from pose, velocity, the next gate and the two after it, which a policy could see
or have as input; its one memory is which gate comes next. It predicts the state by the vehicle's
lag, plans the path of least acceleration through the gates ahead (`guidance`), and leans along it;
it slows down where the path would need more lean than there is. After a miss it backs off, nose
towards the gate, and flies at it again. After the last gate it brakes and hovers.

Horizontal vectors are complex numbers, north + 1j * east: a product with the conjugate of a unit
vector has the component along it as its real part and the one to its right as its imaginary part.
"""

import cmath
import math
from dataclasses import dataclass, replace

from sitl import UsageError
from sitl.ardupilot.params import Params
from sitl.course.layout import Course, Gate
from sitl.course.referee import GateCounter, crossing
from sitl.expert.guidance import Plan, Waypoint, least_acceleration
from sitl.expert.stick_response import DRAG_PER_S, Demand, StickPositions, StickResponse
from sitl.rotation import Vec3, rotate, to_euler, wrap_pi
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.control import clamp
from sitl.vehicle.dynamics import GRAVITY_MPS2, BodyState

LAG_S = 0.17  # from stick to lean, of the nominal vehicle
GATES_AHEAD = 3
MAX_ACCEL_MPS2 = 5.3  # a lean of 28 degrees of the 30 that there are
CORNER_ACCEL_MPS2 = 4.2
"""Most that the planned path may need before it slows down; the rest is for gusts and mistakes."""
ALONG_ACCEL_MPS2 = (-4.0, 3.0)
PLANNED_BRAKING_MPS2 = 2.5
PLANNED_ACCEL_MPS2 = 1.5
SPEED_GAIN_PER_S = 1.5
MIN_SPEED_MPS = 1.5
MAX_SPEED_MPS = 10.0
LOOK_M = 5.0  # the nose points at the next gate, and nearer than this along the leg after it
YAW_GAIN_PER_S = 2.5
MAX_YAW_RATE_RADPS = math.radians(110.0)
CLIMB_LEAD_S = 0.4
TAKEOFF_CLIMB_MPS = 1.6
TAKEOFF_HEIGHT_M = (0.4, 1.4)
"""Below the first it only climbs, above the second it flies at full speed."""
BACKING_SPEED_MPS = 2.5
CLEAR_OF_FRAME_M = 2.4  # sideways from the axis of a gate, with the vehicle's own size
CLIMB_ACCEL_MPS2 = 2.0
MISS_M = (0.7, 1.2)
"""Predicted distance from the axis in the plane of a gate, with full lean: from the first on it
begins to back off, at the second it does nothing else."""
BRAKING_GAIN_PER_S = 1.2
BEYOND_LEG_M = 8.0
BRAKING_DISTANCE_M = 4.0  # beyond the last gate, until it brakes in full


class Expert:
    """Demonstrator of one flight over a course; call `sticks` at 50 Hz or more.

    ``speed_mps`` is its speed where the course allows it: at 8 m/s it slows down for corners.
    ``params`` are the vehicle's: what a stick means, and how fast the vehicle responds.

    Raises:
        UsageError: a speed that it cannot fly at.
    """

    def __init__(
        self, course: Course, speed_mps: float, *, next_gate: int = 0, params: Params | None = None
    ) -> None:
        if not MIN_SPEED_MPS <= speed_mps <= MAX_SPEED_MPS:
            raise UsageError(
                f"the expert flies at {MIN_SPEED_MPS} to {MAX_SPEED_MPS} m/s, got {speed_mps}"
            )
        self._last = course.gates[-1]
        # Points straight on from the last gate, so that it is flown like any other.
        north_m, east_m, down_m = self._last.center_ned_m
        step_m = cmath.rect(BEYOND_LEG_M, self._last.yaw_rad)
        beyond_ned_m = [
            (north_m + k * step_m.real, east_m + k * step_m.imag, down_m)
            for k in range(1, GATES_AHEAD + 1)
        ]
        self._beyond = tuple(replace(self._last, center_ned_m=point) for point in beyond_ned_m)
        self._gates = course.gates + self._beyond
        self._speed_mps = speed_mps
        self._referee = GateCounter(course, first=next_gate)
        params = Params() if params is None else params
        self._lag_s = LAG_S + (params.decimal("ATC_INPUT_TC") - NOMINAL.input_time_s)
        self._response = StickResponse(params)

    @property
    def next_gate(self) -> int | None:
        """Index of the gate to be passed next; None after the last."""
        return self._referee.next_gate

    def sticks(self, body: BodyState, t_s: float) -> StickPositions:
        """Sticks for this state; the positions of successive calls are the flown trajectory."""
        self._referee.update(body.position_ned_m, t_s)
        state = _predict(body, self._lag_s)
        ahead = self._gates_ahead(body.position_ned_m, state)
        demand = _approach(state, ahead[:GATES_AHEAD], self._speed_mps)
        if len(ahead) <= GATES_AHEAD:
            beyond_m, _, _ = self._last.offset_m(state.position_ned_m)
            demand = _blend(demand, _brake(state), _smoothstep(beyond_m, 0.0, BRAKING_DISTANCE_M))
        elif (share := _back_off_share(state, ahead[0])) > 0.0:
            demand = _blend(demand, _back_off(state, ahead[0]), share)
        climb_away = Demand(_brake(state).accel_mps2, TAKEOFF_CLIMB_MPS, demand.yaw_rate_radps)
        flying = _smoothstep(-state.position_ned_m[2], *TAKEOFF_HEIGHT_M)
        demand = _blend(climb_away, demand, flying)
        return self._response.sticks(demand, state.velocity_mps, state.yaw_rad)

    def _gates_ahead(self, position_ned_m: Vec3, state: "_State") -> tuple[Gate, ...]:
        """Gates still to fly, without one that will be behind by the time that the sticks act."""
        next_gate = self.next_gate
        if next_gate is None:
            return self._beyond
        ahead = self._gates[next_gate:]
        is_passing = crossing(ahead[0], position_ned_m, state.position_ned_m) is not None
        return ahead[1:] if is_passing else ahead


@dataclass(frozen=True, slots=True, kw_only=True)
class _State:
    """The vehicle one lag from now, if the sticks stay as they are."""

    position_ned_m: Vec3
    velocity_ned_mps: Vec3
    yaw_rad: float

    @property
    def velocity_mps(self) -> complex:
        north, east, _ = self.velocity_ned_mps
        return complex(north, east)


def _predict(body: BodyState, lag_s: float) -> _State:
    """Extrapolate by the lag, with the acceleration of the present lean in level flight."""
    thrust_n, thrust_e, thrust_d = rotate(body.ned_from_body_wxyz, (0.0, 0.0, -1.0))
    per_g = GRAVITY_MPS2 / max(0.5, -thrust_d)
    velocity_n, velocity_e, velocity_d = body.velocity_ned_mps
    accel_n = thrust_n * per_g - DRAG_PER_S * velocity_n
    accel_e = thrust_e * per_g - DRAG_PER_S * velocity_e
    half = lag_s * lag_s / 2
    north_m, east_m, down_m = body.position_ned_m
    _, _, yaw = to_euler(body.ned_from_body_wxyz)
    return _State(
        position_ned_m=(
            north_m + velocity_n * lag_s + accel_n * half,
            east_m + velocity_e * lag_s + accel_e * half,
            down_m + velocity_d * lag_s,
        ),
        velocity_ned_mps=(velocity_n + accel_n * lag_s, velocity_e + accel_e * lag_s, velocity_d),
        yaw_rad=wrap_pi(yaw + body.rate_body_radps[2] * lag_s),
    )


def _approach(state: _State, ahead: tuple[Gate, ...], speed_mps: float) -> Demand:
    """Fly along the path through the gates ahead, at the speed that it allows."""
    velocity = state.velocity_mps
    to_aim_m = _aim_point(state, ahead) - complex(*state.position_ned_m[:2])
    distance_m = max(_length(to_aim_m), 1e-3)
    sight = to_aim_m / distance_m
    closing_mps = max(MIN_SPEED_MPS, (velocity * sight.conjugate()).real)
    waypoints = _waypoints(state, ahead, closing_mps, speed_mps)
    plan = least_acceleration(state.position_ned_m, state.velocity_ned_mps, waypoints)
    accel_n, accel_e, accel_d = plan.accel_mps2[0].tolist()
    # Along the path speed is controlled; the plan's own speed is only what it was timed by.
    along = velocity + MIN_SPEED_MPS * sight
    along /= max(_length(along), 1e-3)
    right_mps2 = clamp((complex(accel_n, accel_e) * along.conjugate()).imag, MAX_ACCEL_MPS2)
    allowed_mps = min(
        speed_mps, closing_mps * _corner_ratio(right_mps2), _corner_speed(plan, waypoints)
    )
    error_mps = max(MIN_SPEED_MPS, allowed_mps) - (velocity * along.conjugate()).real
    low, high = ALONG_ACCEL_MPS2
    room = math.sqrt(MAX_ACCEL_MPS2**2 - right_mps2**2)
    along_mps2 = clamp(max(low, min(high, SPEED_GAIN_PER_S * error_mps)), room)
    turning_radps = (velocity.conjugate() * sight).imag / max(distance_m, LOOK_M / 2)
    return Demand(
        accel_mps2=complex(along_mps2, right_mps2) * along,
        climb_mps=-(state.velocity_ned_mps[2] + CLIMB_LEAD_S * accel_d),
        yaw_rate_radps=_yaw_rate(cmath.phase(sight) - state.yaw_rad, turning_radps),
    )


def _aim_point(state: _State, ahead: tuple[Gate, ...]) -> complex:
    """The next gate; from nearer than ``LOOK_M`` a point that slides along the leg after it."""
    gate = ahead[0]
    forward_m, _, _ = gate.offset_m(state.position_ned_m)
    center, leg, leg_m = complex(*gate.center_ned_m[:2]), cmath.rect(1.0, gate.yaw_rad), 1.0
    if len(ahead) > 1:
        leg = complex(*ahead[1].center_ned_m[:2]) - center
        leg_m = math.dist(ahead[1].center_ned_m, gate.center_ned_m)
    return center + max(0.0, LOOK_M + forward_m) / leg_m * leg


def _waypoints(
    state: _State, ahead: tuple[Gate, ...], closing_mps: float, speed_mps: float
) -> list[Waypoint]:
    """The gates, each leg timed by the speed that can be reached half-way along it."""
    waypoints = []
    before, covered_m = state.position_ned_m, 0.0
    for gate in ahead:
        # Off the axis the distance does not shrink to nothing in the plane of the gate; time must.
        forward_m, right_m, _ = gate.offset_m(before)
        leg_m = math.hypot(min(0.0, forward_m), max(0.0, abs(right_m) - gate.size_m / 2))
        gained = 2 * PLANNED_ACCEL_MPS2 * (covered_m + leg_m / 2)
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


def _corner_speed(plan: Plan, waypoints: list[Waypoint]) -> float:
    """The speed from which it can still slow down for the corners at the gates ahead."""
    allowed_mps, distance_m = math.inf, 0.0
    for waypoint, accel in zip(waypoints, plan.accel_mps2[1:].tolist(), strict=True):
        timed_mps = math.hypot(*waypoint.velocity_mps)
        distance_m += waypoint.leg_s * timed_mps
        corner_mps = timed_mps * _corner_ratio(math.hypot(*accel[:2]))
        braking = 2 * PLANNED_BRAKING_MPS2 * distance_m
        allowed_mps = min(allowed_mps, math.sqrt(corner_mps**2 + braking))
    return allowed_mps


def _corner_ratio(accel_mps2: float) -> float:
    """Factor by which a corner can be flown faster than at this lateral acceleration."""
    return math.sqrt(CORNER_ACCEL_MPS2 / max(abs(accel_mps2), 1e-3))


def _back_off_share(state: _State, gate: Gate) -> float:
    """0 where the gate can be flown at from here; 1 where it cannot, since the vehicle is beside or
    behind it, or too fast and too far off to get into the opening."""
    forward_m, right_m, down_m = gate.offset_m(state.position_ned_m)
    if forward_m >= 0.0:
        return 1.0
    reach_m = gate.size_m / 2 + 0.2 - 0.8 * forward_m
    beside = _smoothstep(abs(right_m) - reach_m, 0.0, 1.5)
    forward_mps, rightward_mps, downward_mps = gate.to_axes(state.velocity_ned_mps)
    left_s = -forward_m / max(forward_mps, MIN_SPEED_MPS)
    right_miss_m = abs(right_m + rightward_mps * left_s) - MAX_ACCEL_MPS2 * left_s**2 / 2
    down_miss_m = abs(down_m + downward_mps * left_s) - CLIMB_ACCEL_MPS2 * left_s**2 / 2
    return max(beside, _smoothstep(max(right_miss_m, down_miss_m), *MISS_M))


def _back_off(state: _State, gate: Gate) -> Demand:
    """Fly backwards beside the gate, nose along its passage, until it is in front again."""
    forward_m, right_m, down_m = gate.offset_m(state.position_ned_m)
    is_beside = forward_m > -1.0 and abs(right_m) < CLEAR_OF_FRAME_M
    side_m = math.copysign(CLEAR_OF_FRAME_M, right_m) if is_beside else right_m
    across_mps = clamp(side_m - right_m, 2.0)
    wanted_mps = complex(-BACKING_SPEED_MPS, across_mps) * cmath.rect(1.0, gate.yaw_rad)
    accel = SPEED_GAIN_PER_S * (wanted_mps - state.velocity_mps)
    return Demand(
        accel_mps2=min(1.0, -ALONG_ACCEL_MPS2[0] / max(1e-6, _length(accel))) * accel,
        climb_mps=0.0 if is_beside else clamp(down_m, 1.0),
        yaw_rate_radps=_yaw_rate(gate.yaw_rad - state.yaw_rad, 0.0),
    )


def _brake(state: _State) -> Demand:
    """Brake to a hover."""
    most_mps = -ALONG_ACCEL_MPS2[0] / BRAKING_GAIN_PER_S
    gain = BRAKING_GAIN_PER_S * min(1.0, most_mps / max(1e-6, _length(state.velocity_mps)))
    return Demand(-gain * state.velocity_mps, 0.0, 0.0)


def _yaw_rate(error_rad: float, lead_radps: float) -> float:
    rate_radps = YAW_GAIN_PER_S * wrap_pi(error_rad) + lead_radps
    return MAX_YAW_RATE_RADPS * math.tanh(rate_radps / MAX_YAW_RATE_RADPS)


def _blend(a: Demand, b: Demand, share: float) -> Demand:
    """``a`` at a share of 0, ``b`` at 1."""
    return Demand(
        accel_mps2=a.accel_mps2 + share * (b.accel_mps2 - a.accel_mps2),
        climb_mps=a.climb_mps + share * (b.climb_mps - a.climb_mps),
        yaw_rate_radps=a.yaw_rate_radps + share * (b.yaw_rate_radps - a.yaw_rate_radps),
    )


def _length(vector: complex) -> float:
    """More exact than ``abs``, which may differ from one platform's C library to another."""
    return math.hypot(vector.real, vector.imag)


def _smoothstep(value: float, low: float, high: float) -> float:
    fraction = max(0.0, min(1.0, (value - low) / (high - low)))
    return fraction * fraction * (3.0 - 2.0 * fraction)
