"""A demonstrator: flies a gate course with sticks alone, in ALT_HOLD, from the true pose.

What it holds follows from pose, velocity, the next gate and the two after it: what a policy could
see or be told. Its one memory is which gate comes next. It looks ahead by the vehicle's own lag,
plans the path of least acceleration through the gates ahead (`guidance`), and leans along it;
speed is given up where the path would need more lean than there is. A gate that was missed is flown
at again, after backing off with the nose towards it. After the last gate it brakes and hovers.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

from sitl.course.layout import Course, Gate
from sitl.course.referee import GateCounter, crossing
from sitl.errors import UsageError
from sitl.expert.guidance import Knot, Plan, least_acceleration
from sitl.rotation import Quat, Vec3, rotate, to_euler, wrap_pi
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.control import clamp
from sitl.vehicle.dynamics import GRAVITY_MPS2
from sitl.vehicle.params import Params

LAG_S = 0.17
"""From stick to lean, of the nominal vehicle; position and velocity are rolled forward by it."""
GATES_AHEAD = 3
MAX_ACCEL_MPS2 = 5.3
"""A lean of 28 degrees of the 30 that there are."""
CORNER_ACCEL_MPS2 = 4.2
"""What the planned path may need before speed is given up; the rest is for gusts and mistakes."""
ALONG_ACCEL_MPS2 = (-4.0, 3.0)
PLANNED_BRAKING_MPS2 = 2.5
PLANNED_ACCEL_MPS2 = 1.5
SPEED_GAIN_PER_S = 1.5
DRAG_PER_S = 0.125
"""Linear drag over mass, leant against."""
MIN_SPEED_MPS = 1.5
MAX_SPEED_MPS = 10.0
LOOK_M = 5.0
"""The nose points at the next gate, and nearer than this along the leg after it."""
YAW_GAIN_PER_S = 2.5
MAX_YAW_RATE_RADPS = math.radians(110.0)
CLIMB_LEAD_S = 0.4
TAKEOFF_CLIMB_MPS = 1.6
TAKEOFF_HEIGHT_M = (0.4, 1.4)
"""Below the first it only climbs, above the second it flies at full speed."""
BACKING_SPEED_MPS = 2.5
CLEAR_OF_FRAME_M = 2.4
"""From the axis of a gate to the side: clear of its frame with the vehicle's own size."""
CLIMB_ACCEL_MPS2 = 2.0
MISS_M = (0.7, 1.2)
"""From the axis in the plane of a gate, with all that leaning can do: from the first on it begins
to back off, at the second it does nothing else."""
BRAKING_GAIN_PER_S = 1.2
BEYOND_LEG_M = 8.0
BRAKING_BEGINS_M = 4.0
"""Beyond the last gate it brakes in full."""
DEAD_ZONE_SLOPE = 0.08
"""A dead zone is jumped over within about this share of full scale."""


class StickPositions(NamedTuple):
    """Stick positions in [-1, 1], in the order of the action vector."""

    throttle: float
    """0 = mid-stick, + up."""
    yaw: float
    """+ nose right."""
    pitch: float
    """+ stick forward, nose down."""
    roll: float
    """+ right."""


CENTRED = StickPositions(0.0, 0.0, 0.0, 0.0)


class Expert:
    """One flight over a course; ask it at the rate at which sticks are sent, 50 Hz or more.

    ``speed_mps`` is what it flies where the course lets it: at 8 m/s it slows down for corners.
    ``params`` are the vehicle's: what a stick means, and how fast it is obeyed.

    Raises:
        UsageError: a speed that it cannot fly at.
    """

    def __init__(
        self,
        course: Course,
        speed_mps: float,
        *,
        next_gate: int = 0,
        params: Params | None = None,
    ) -> None:
        if not MIN_SPEED_MPS <= speed_mps <= MAX_SPEED_MPS:
            raise UsageError(
                f"the expert flies at {MIN_SPEED_MPS} to {MAX_SPEED_MPS} m/s, got {speed_mps}"
            )
        self._last = course.gates[-1]
        self._beyond = _straight_on(self._last)
        self._gates = course.gates + self._beyond
        self._speed_mps = speed_mps
        self._referee = GateCounter(course, first=next_gate)
        params = Params() if params is None else params
        self._lag_s = LAG_S + (params.decimal("ATC_INPUT_TC") - NOMINAL.input_time_s)
        self._response = _Response(params)

    @property
    def next_gate(self) -> int | None:
        """Index of the gate to be passed next; None after the last."""
        return self._referee.next_gate

    def sticks(
        self,
        position_ned_m: Vec3,
        velocity_ned_mps: Vec3,
        ned_from_body_wxyz: Quat,
        rate_body_radps: Vec3,
        t_s: float,
    ) -> StickPositions:
        """What to hold now; the positions of all calls are the trajectory that passes gates."""
        self._referee.update(position_ned_m, t_s)
        state = _State.ahead(
            position_ned_m,
            velocity_ned_mps,
            ned_from_body_wxyz,
            rate_body_radps,
            lag_s=self._lag_s,
        )
        ahead = self._ahead(position_ned_m, state)
        wanted = _approach(state, ahead[:GATES_AHEAD], self._speed_mps)
        if len(ahead) <= GATES_AHEAD:
            wanted = _mixed(wanted, _brake(state), _past(state, self._last))
        elif (backing := _must_back_off(state, ahead[0])) > 0.0:
            wanted = _mixed(wanted, _back_off(state, ahead[0]), backing)
        flying = _smoothstep(state.height_m, *TAKEOFF_HEIGHT_M)
        return self._response.sticks(_mixed(_climb_away(state, wanted), wanted, flying), state)

    def _ahead(self, position_ned_m: Vec3, state: "_State") -> tuple[Gate, ...]:
        """What is still to fly, less a gate that will be behind by the time that the sticks act."""
        next_gate = self.next_gate
        if next_gate is None:
            return self._beyond
        ahead = self._gates[next_gate:]
        passing = crossing(ahead[0], position_ned_m, state.position_m) is not None
        return ahead[1:] if passing else ahead


class _Demand(NamedTuple):
    """What the sticks are to bring about."""

    accel_north_mps2: float
    accel_east_mps2: float
    climb_mps: float
    yaw_rate_radps: float


@dataclass(frozen=True, slots=True, kw_only=True)
class _State:
    """The vehicle one lag from now, if the sticks change nothing before."""

    position_m: Vec3
    velocity_mps: Vec3
    yaw_rad: float

    @property
    def height_m(self) -> float:
        return -self.position_m[2]

    @classmethod
    def ahead(
        cls,
        position_m: Vec3,
        velocity_mps: Vec3,
        ned_from_body: Quat,
        rate_body_radps: Vec3,
        *,
        lag_s: float,
    ) -> "_State":
        thrust = rotate(ned_from_body, (0.0, 0.0, -1.0))
        per_g = GRAVITY_MPS2 / max(0.5, -thrust[2])
        velocity_n, velocity_e, velocity_d = velocity_mps
        accel_n = thrust[0] * per_g - DRAG_PER_S * velocity_n
        accel_e = thrust[1] * per_g - DRAG_PER_S * velocity_e
        half = lag_s * lag_s / 2
        north_m, east_m, down_m = position_m
        _, _, yaw = to_euler(ned_from_body)
        return cls(
            position_m=(
                north_m + velocity_n * lag_s + accel_n * half,
                east_m + velocity_e * lag_s + accel_e * half,
                down_m + velocity_d * lag_s,
            ),
            velocity_mps=(velocity_n + accel_n * lag_s, velocity_e + accel_e * lag_s, velocity_d),
            yaw_rad=wrap_pi(yaw + rate_body_radps[2] * lag_s),
        )


def _approach(state: _State, ahead: tuple[Gate, ...], speed_mps: float) -> _Demand:
    """Along the path through the gates ahead, at the speed that it allows."""
    to_north, to_east, _ = _minus(_look_point(state, ahead), state.position_m)
    distance_m = max(math.hypot(to_north, to_east), 1e-3)
    sight = (to_north / distance_m, to_east / distance_m)
    velocity_n, velocity_e, velocity_d = state.velocity_mps
    closing_mps = max(MIN_SPEED_MPS, velocity_n * sight[0] + velocity_e * sight[1])
    knots = _knots(state, ahead, closing_mps, speed_mps)
    plan = least_acceleration(state.position_m, state.velocity_mps, knots)
    accel_n, accel_e, accel_d = plan.accel_mps2[0].tolist()
    # Along the path speed is held: the plan's own idea of it is only what it was timed by.
    along_n, along_e = velocity_n + MIN_SPEED_MPS * sight[0], velocity_e + MIN_SPEED_MPS * sight[1]
    length = max(math.hypot(along_n, along_e), 1e-3)
    along_n, along_e = along_n / length, along_e / length
    across = clamp(accel_e * along_n - accel_n * along_e, MAX_ACCEL_MPS2)
    allowed_mps = min(speed_mps, closing_mps * _corner_ratio(across), _corner_speed(plan, knots))
    error_mps = max(MIN_SPEED_MPS, allowed_mps) - (velocity_n * along_n + velocity_e * along_e)
    low, high = ALONG_ACCEL_MPS2
    room = math.sqrt(MAX_ACCEL_MPS2**2 - across**2)
    along = clamp(max(low, min(high, SPEED_GAIN_PER_S * error_mps)), room)
    return _Demand(
        accel_north_mps2=along * along_n - across * along_e,
        accel_east_mps2=along * along_e + across * along_n,
        climb_mps=-(velocity_d + CLIMB_LEAD_S * accel_d),
        yaw_rate_radps=_turn_to(state, sight, distance_m),
    )


def _corner_speed(plan: Plan, knots: list[Knot]) -> float:
    """The speed from which it can still slow down for the corners at the gates ahead."""
    allowed_mps, way_m = math.inf, 0.0
    for knot, (accel_n, accel_e, _) in zip(knots, plan.accel_mps2[1:].tolist(), strict=True):
        timed_mps = math.hypot(*knot.velocity_mps)
        way_m += knot.leg_s * timed_mps
        corner_mps = timed_mps * _corner_ratio(math.hypot(accel_n, accel_e))
        allowed_mps = min(allowed_mps, math.sqrt(corner_mps**2 + 2 * PLANNED_BRAKING_MPS2 * way_m))
    return allowed_mps


def _corner_ratio(accel_mps2: float) -> float:
    """How much faster or slower a corner can be flown than at this acceleration across."""
    return math.sqrt(CORNER_ACCEL_MPS2 / max(abs(accel_mps2), 1e-3))


def _knots(
    state: _State, ahead: tuple[Gate, ...], closing_mps: float, speed_mps: float
) -> list[Knot]:
    """The gates, each leg timed by the speed that can be reached half-way along it."""
    knots = []
    before, way_m = state.position_m, 0.0
    for gate in ahead:
        # Off the axis the way does not shrink to nothing in the plane of the gate; time must.
        axial_m, right_m, _ = gate.offset_m(before)
        leg_m = math.hypot(min(0.0, axial_m), max(0.0, abs(right_m) - gate.size_m / 2))
        gained = 2 * PLANNED_ACCEL_MPS2 * (way_m + leg_m / 2)
        pace_mps = min(max(closing_mps, speed_mps), math.sqrt(closing_mps**2 + gained))
        knots.append(
            Knot(
                point_m=gate.center_ned_m,
                velocity_mps=_along_passage(gate, pace_mps),
                leg_s=leg_m / pace_mps,
            )
        )
        before, way_m = gate.center_ned_m, way_m + leg_m
    return knots


def _look_point(state: _State, ahead: tuple[Gate, ...]) -> Vec3:
    """The next gate; from nearer than ``LOOK_M`` a point that slides along the leg after it."""
    gate = ahead[0]
    axial_m, _, _ = gate.offset_m(state.position_m)
    beyond_m = max(0.0, LOOK_M + axial_m)
    if len(ahead) > 1:
        leg = _minus(ahead[1].center_ned_m, gate.center_ned_m)
        leg_m = math.hypot(*leg)
    else:
        leg, leg_m = _along_passage(gate, 1.0), 1.0
    north_m, east_m, down_m = (
        center + beyond_m / leg_m * part
        for center, part in zip(gate.center_ned_m, leg, strict=True)
    )
    return (north_m, east_m, down_m)


def _must_back_off(state: _State, gate: Gate) -> float:
    """0 where the gate can be flown at from here, 1 where it cannot: beside it, behind it, or too
    fast and too far off to get into the opening.
    """
    axial_m, right_m, down_m = gate.offset_m(state.position_m)
    if axial_m >= 0.0:
        return 1.0
    reach_m = gate.size_m / 2 + 0.2 - 0.8 * axial_m
    beside = _smoothstep(abs(right_m) - reach_m, 0.0, 1.5)
    forward_mps, rightward_mps, downward_mps = gate.to_axes(state.velocity_mps)
    left_s = -axial_m / max(forward_mps, MIN_SPEED_MPS)
    right_miss_m = abs(right_m + rightward_mps * left_s) - MAX_ACCEL_MPS2 * left_s**2 / 2
    down_miss_m = abs(down_m + downward_mps * left_s) - CLIMB_ACCEL_MPS2 * left_s**2 / 2
    missing = _smoothstep(max(right_miss_m, down_miss_m), *MISS_M)
    return max(beside, missing)


def _back_off(state: _State, gate: Gate) -> _Demand:
    """Backwards beside the gate, nose along its passage, until it is in front again."""
    axial_m, right_m, down_m = gate.offset_m(state.position_m)
    cos_yaw, sin_yaw = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
    beside = axial_m > -1.0 and abs(right_m) < CLEAR_OF_FRAME_M
    side_m = math.copysign(CLEAR_OF_FRAME_M, right_m) if beside else right_m
    across_mps = max(-2.0, min(2.0, side_m - right_m))
    wanted_n = -BACKING_SPEED_MPS * cos_yaw - across_mps * sin_yaw
    wanted_e = -BACKING_SPEED_MPS * sin_yaw + across_mps * cos_yaw
    accel_n = SPEED_GAIN_PER_S * (wanted_n - state.velocity_mps[0])
    accel_e = SPEED_GAIN_PER_S * (wanted_e - state.velocity_mps[1])
    scale = min(1.0, -ALONG_ACCEL_MPS2[0] / max(1e-6, math.hypot(accel_n, accel_e)))
    return _Demand(
        accel_north_mps2=scale * accel_n,
        accel_east_mps2=scale * accel_e,
        climb_mps=0.0 if beside else max(-1.0, min(1.0, down_m)),
        yaw_rate_radps=_turn(wrap_pi(gate.yaw_rad - state.yaw_rad), 0.0),
    )


def _climb_away(state: _State, wanted: _Demand) -> _Demand:
    """Straight up from the ground, with the nose where it is wanted."""
    return _brake(state)._replace(climb_mps=TAKEOFF_CLIMB_MPS, yaw_rate_radps=wanted.yaw_rate_radps)


def _brake(state: _State) -> _Demand:
    """To a hover, wherever that is."""
    velocity_n, velocity_e, _ = state.velocity_mps
    gain = BRAKING_GAIN_PER_S
    fastest_mps = -ALONG_ACCEL_MPS2[0] / gain
    gain *= min(1.0, fastest_mps / max(1e-6, math.hypot(velocity_n, velocity_e)))
    return _Demand(-gain * velocity_n, -gain * velocity_e, 0.0, 0.0)


def _past(state: _State, last: Gate) -> float:
    """1 where the last gate is far enough behind to brake in full."""
    beyond_m, _, _ = last.offset_m(state.position_m)
    return _smoothstep(beyond_m, 0.0, BRAKING_BEGINS_M)


def _straight_on(last: Gate) -> tuple[Gate, ...]:
    """Points on the way out of the last gate, so that it is flown like any other."""
    north_m, east_m, down_m = last.center_ned_m
    ahead_n, ahead_e, _ = _along_passage(last, BEYOND_LEG_M)
    return tuple(
        replace(last, center_ned_m=(north_m + k * ahead_n, east_m + k * ahead_e, down_m))
        for k in range(1, GATES_AHEAD + 1)
    )


def _turn_to(state: _State, sight: tuple[float, float], distance_m: float) -> float:
    """Yaw rate that keeps the nose on a fixed point, led by the turning of the line of sight."""
    velocity_n, velocity_e, _ = state.velocity_mps
    turning = (velocity_n * sight[1] - velocity_e * sight[0]) / max(distance_m, LOOK_M / 2)
    return _turn(wrap_pi(math.atan2(sight[1], sight[0]) - state.yaw_rad), turning)


def _turn(error_rad: float, lead_radps: float) -> float:
    rate = YAW_GAIN_PER_S * error_rad + lead_radps
    return MAX_YAW_RATE_RADPS * math.tanh(rate / MAX_YAW_RATE_RADPS)


class _Response:
    """From what is wanted to the sticks that ArduCopter's ALT_HOLD turns into it."""

    def __init__(self, params: Params) -> None:
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

    def sticks(self, wanted: _Demand, state: _State) -> StickPositions:
        """Leans by the ratio to gravity in the heading's axes, rates by their full scale."""
        velocity_n, velocity_e, _ = state.velocity_mps
        accel_n = wanted.accel_north_mps2 + DRAG_PER_S * velocity_n
        accel_e = wanted.accel_east_mps2 + DRAG_PER_S * velocity_e
        cos_yaw, sin_yaw = math.cos(state.yaw_rad), math.sin(state.yaw_rad)
        forward = (accel_n * cos_yaw + accel_e * sin_yaw) / GRAVITY_MPS2
        right = (accel_e * cos_yaw - accel_n * sin_yaw) / GRAVITY_MPS2
        nose_down_rad = math.atan(forward)
        right_rad = math.atan(right * math.cos(nose_down_rad))
        full_mps = self._climb_mps if wanted.climb_mps > 0.0 else self._descent_mps
        turn = wanted.yaw_rate_radps / self._yaw_radps
        return StickPositions(
            throttle=_past_dead_zone(wanted.climb_mps / full_mps, self._throttle_dead),
            yaw=_past_dead_zone(_without_expo(turn, self._yaw_expo), self._yaw_dead),
            pitch=_past_dead_zone(nose_down_rad / self._lean_rad, self._pitch_dead),
            roll=_past_dead_zone(right_rad / self._lean_rad, self._roll_dead),
        )


def _without_expo(value: float, expo: float) -> float:
    """The input that ArduPilot's ``input_expo`` makes this value of."""
    return value / (1.0 - expo * (1.0 - abs(value)))


def _past_dead_zone(value: float, dead: float) -> float:
    """The stick whose effect is ``value`` of full scale; around the middle a slope, not a jump."""
    stick = (1.0 - dead) * value + dead * math.tanh(value / DEAD_ZONE_SLOPE)
    return max(-1.0, min(1.0, stick))


def _along_passage(gate: Gate, speed_mps: float) -> Vec3:
    return (speed_mps * math.cos(gate.yaw_rad), speed_mps * math.sin(gate.yaw_rad), 0.0)


def _minus(a: Vec3, b: Vec3) -> Vec3:
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


def _mixed(a: _Demand, b: _Demand, share: float) -> _Demand:
    """``a`` at 0, ``b`` at 1."""
    return _Demand(*(x + share * (y - x) for x, y in zip(a, b, strict=True)))


def _smoothstep(value: float, low: float, high: float) -> float:
    fraction = max(0.0, min(1.0, (value - low) / (high - low)))
    return fraction * fraction * (3.0 - 2.0 * fraction)
