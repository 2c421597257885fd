"""Experts that fly a gate course from the true pose: by sticks in ALT_HOLD, or by body rates."""

import cmath
import math
from typing import NamedTuple

from sitl.pilot.course_guide import Agility, CourseGuide, Demand, Predicted
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.dynamics import GRAVITY_MPS2, BodyState, clamp
from sitl.vehicle.rotation import Quat, Vec3, conjugate, integrate, plus, rotate, wrap_pi, yaw_of

HOVER_THRUST = 0.39
TILT_GAIN_PER_S = 8.0
CLIMB_GAIN_PER_S = 4.0
MAX_TILT_RAD = math.radians(62.0)
FORCE_MPS2 = (3.0, 21.0)  # least and most specific force
MAX_RATE_RADPS = math.radians(200.0)
MAX_YAW_RATE_RADPS = math.radians(115.0)


class RateCommand(NamedTuple):
    """Collective thrust and body rates, in FRD axes and the order of the action vector."""

    thrust: float  # in [0, 1]; ``HOVER_THRUST`` hovers
    roll_radps: float
    pitch_radps: float
    yaw_radps: float


def rate_command(
    demand: Demand, state: Predicted, ned_from_body: Quat, drag_ned_mps2: Vec3
) -> RateCommand:
    """Return thrust and rates for a demand, in a predicted state and attitude, against this drag.

    The thrust vector turns the shorter way round to the direction that the demand needs. Tilt has
    its own loop; heading follows only by its rate, because the thrust's direction matters more than
    the nose's (Brescianini and D'Andrea, "Tilt-Prioritized Quadrocopter Attitude Control", 2018).
    """
    force_ned = _specific_force(demand, state, drag_ned_mps2)
    size = math.hypot(*force_ned)
    body_from_ned = conjugate(ned_from_body)
    x, y, z = (part / size for part in rotate(body_from_ned, force_ned))
    # Rotation vector that takes the thrust, along -z of the body, to the force.
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
    """Return the specific force of the thrust in NED, limited in tilt and size."""
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


DEAD_ZONE_SLOPE = 0.08
"""Share of full scale over which a dead zone is crossed, by a slope instead of a jump."""


class StickPositions(NamedTuple):
    """Stick positions in [-1, 1], in the order of the action vector."""

    throttle: float  # 0 = mid-stick, + up
    yaw: float  # + nose right
    pitch: float  # + stick forward, nose down
    roll: float  # + right


CENTRED = StickPositions(0.0, 0.0, 0.0, 0.0)


LEAN_RAD = math.radians(NOMINAL.angle_max_cdeg / 100.0)
YAW_RADPS = math.radians(NOMINAL.pilot_yaw_rate_degps)
CLIMB_MPS = NOMINAL.pilot_speed_up_cmps / 100.0
ROLL_DEAD, PITCH_DEAD, _, YAW_DEAD = (dead_us / 500.0 for dead_us in NOMINAL.rc_dead_zones_us)
THROTTLE_DEAD = NOMINAL.throttle_dead_zone_permille / 5e5 * (1000.0 - NOMINAL.rc_dead_zones_us[2])
"""Shares of the travel to each side; THR_DZ counts beyond the dead zone of its channel."""


def sticks_for(demand: Demand, drag_mps2: complex, yaw_rad: float) -> StickPositions:
    """Convert a demand to the nominal vehicle's ALT_HOLD sticks: leans that give its acceleration
    against this drag, and rates as shares of full scale."""
    accel_mps2 = demand.accel_mps2 - drag_mps2
    forward_right = accel_mps2 * cmath.rect(1.0, -yaw_rad) / GRAVITY_MPS2
    nose_down_rad = math.atan(forward_right.real)
    right_rad = math.atan(forward_right.imag * math.cos(nose_down_rad))
    return StickPositions(
        throttle=_past_dead_zone(demand.climb_mps / CLIMB_MPS, THROTTLE_DEAD),
        yaw=_past_dead_zone(demand.yaw_rate_radps / YAW_RADPS, YAW_DEAD),
        pitch=_past_dead_zone(nose_down_rad / LEAN_RAD, PITCH_DEAD),
        roll=_past_dead_zone(right_rad / LEAN_RAD, ROLL_DEAD),
    )


def _past_dead_zone(value: float, dead: float) -> float:
    """Return the stick whose effect is ``value`` of full scale."""
    return clamp((1.0 - dead) * value + dead * math.tanh(value / DEAD_ZONE_SLOPE), 1.0)


STICK_LAG_S = 0.17  # from stick to lean, of the nominal vehicle
STICK_AGILITY = Agility(
    max_speed_mps=10.0,
    max_accel_mps2=5.3,  # a lean of 28 of at most 30 degrees
    corner_accel_mps2=4.2,
    along_accel_mps2=(-4.0, 3.0),
    planned_braking_mps2=2.5,
    planned_accel_mps2=1.5,
    climb_accel_mps2=2.0,
    climb_lead_s=0.4,
    takeoff_climb_mps=1.6,
    braking_distance_m=4.0,
)
RATE_LAG_S = 0.06  # from rate command to rate: motors and the rate loop
RATE_AGILITY = Agility(
    max_speed_mps=14.0,
    max_accel_mps2=13.0,  # a lean of 53 degrees
    corner_accel_mps2=10.0,
    along_accel_mps2=(-7.0, 6.0),
    planned_braking_mps2=4.5,
    planned_accel_mps2=3.0,
    climb_accel_mps2=5.0,
    climb_lead_s=0.25,
    takeoff_climb_mps=2.5,
    braking_distance_m=8.0,
)


def expert_sticks(guide: CourseGuide, body: BodyState, t_s: float) -> StickPositions:
    """Return the sticks for this state, by a guide of ``STICK_AGILITY``; call at 50 Hz or more.

    Positions of successive calls are the flown trajectory. The expert does not know the vehicle's
    parameters: it has the nominal vehicle's stick curves and lag.
    """
    north_mps2, east_mps2, _ = drag_ned_mps2 = _drag_ned_mps2(body)
    state = _predict(body, _level_accel_mps2(body, drag_ned_mps2), STICK_LAG_S)
    demand = guide.demand(body.position_ned_m, t_s, state)
    return sticks_for(demand, complex(north_mps2, east_mps2), state.yaw_rad)


def expert_rates(guide: CourseGuide, body: BodyState, t_s: float) -> RateCommand:
    """Return thrust and rates for this state, by a guide of ``RATE_AGILITY``; call at 100 Hz or
    more, with the positions of one trajectory."""
    ned_from_body = integrate(body.ned_from_body_wxyz, body.rate_body_radps, RATE_LAG_S)
    north, east, down = rotate(body.ned_from_body_wxyz, body.specific_force_body_mps2)
    state = _predict(body, (north, east, down + GRAVITY_MPS2), RATE_LAG_S)
    demand = guide.demand(body.position_ned_m, t_s, state)
    return rate_command(demand, state, ned_from_body, _drag_ned_mps2(body))


def _drag_ned_mps2(body: BodyState) -> Vec3:
    """Return drag over mass, for any airframe in any wind; 0 on the ground.

    Thrust acts along the body's third axis, so an accelerometer measures drag on the other two.
    """
    if body.touching:
        return (0.0, 0.0, 0.0)
    drag_x, drag_y, _ = body.specific_force_body_mps2
    return rotate(body.ned_from_body_wxyz, (drag_x, drag_y, 0.0))


def _level_accel_mps2(body: BodyState, drag_ned_mps2: Vec3) -> Vec3:
    """Return the acceleration of the present lean in level flight."""
    thrust_ned = rotate(body.ned_from_body_wxyz, (0.0, 0.0, -1.0))
    north, east, _ = plus(drag_ned_mps2, thrust_ned, GRAVITY_MPS2 / max(0.5, -thrust_ned[2]))
    return north, east, 0.0


def _predict(body: BodyState, accel_mps2: Vec3, lag_s: float) -> Predicted:
    """Extrapolate by the lag at this acceleration."""
    moved_m = plus(body.position_ned_m, body.velocity_ned_mps, lag_s)
    return Predicted(
        position_ned_m=plus(moved_m, accel_mps2, lag_s * lag_s / 2),
        velocity_ned_mps=plus(body.velocity_ned_mps, accel_mps2, lag_s),
        yaw_rad=wrap_pi(yaw_of(body.ned_from_body_wxyz) + body.rate_body_radps[2] * lag_s),
    )
