"""Experts that fly a gate course from the true pose: by sticks in ALT_HOLD, or by body rates."""

from sitl.ardupilot.params import ArduPilotParams
from sitl.course.layout import Course
from sitl.expert.course_guide import Agility, CourseGuide, Predicted
from sitl.expert.rate_response import RateCommand, rate_command
from sitl.expert.stick_response import StickPositions, StickResponse
from sitl.rotation import Vec3, integrate, rotate, to_euler, wrap_pi
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.dynamics import GRAVITY_MPS2, BodyState

STICK_LAG_S = 0.17  # from stick to lean, of the nominal vehicle
STICK_AGILITY = Agility(
    max_speed_mps=10.0,
    max_accel_mps2=5.3,  # a lean of 28 degrees of the 30 that there are
    corner_accel_mps2=4.2,
    along_accel_mps2=(-4.0, 3.0),
    planned_braking_mps2=2.5,
    planned_accel_mps2=1.5,
    climb_accel_mps2=2.0,
    climb_lead_s=0.4,
    takeoff_climb_mps=1.6,
    braking_distance_m=4.0,
)
RATE_LAG_S = 0.06  # from rate command to rate: motors, and the loop before them
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


class Expert:
    """Demonstrator of one flight by sticks; call `sticks` at 50 Hz or more.

    ``speed_mps`` is its speed where the course allows it: at 8 m/s it slows down for corners.
    ``params`` are the vehicle's: what a stick means, and how fast the vehicle responds.

    Raises:
        UsageError: a speed that it cannot fly at.
    """

    def __init__(
        self,
        course: Course,
        speed_mps: float,
        *,
        next_gate: int = 0,
        params: ArduPilotParams | None = None,
    ) -> None:
        self._guide = CourseGuide(course, STICK_AGILITY, speed_mps, next_gate)
        params = ArduPilotParams() if params is None else params
        self._lag_s = STICK_LAG_S + (params.decimal("ATC_INPUT_TC") - NOMINAL.input_time_s)
        self._response = StickResponse(params)

    @property
    def next_gate(self) -> int | None:
        """Index of the gate to be passed next; None after the last."""
        return self._guide.next_gate

    def sticks(self, body: BodyState, t_s: float) -> StickPositions:
        """Sticks for this state; the positions of successive calls are the flown trajectory."""
        north_mps2, east_mps2, _ = drag_ned_mps2 = _drag_ned_mps2(body)
        state = _predict_level(body, drag_ned_mps2, self._lag_s)
        demand = self._guide.demand(body.position_ned_m, t_s, state)
        return self._response.sticks(demand, complex(north_mps2, east_mps2), state.yaw_rad)


class RateExpert:
    """Demonstrator of one flight by thrust and body rates; call `command` at 100 Hz or more.

    Raises:
        UsageError: a speed that it cannot fly at.
    """

    def __init__(self, course: Course, speed_mps: float, *, next_gate: int = 0) -> None:
        self._guide = CourseGuide(course, RATE_AGILITY, speed_mps, next_gate)

    @property
    def next_gate(self) -> int | None:
        """Index of the gate to be passed next; None after the last."""
        return self._guide.next_gate

    def command(self, body: BodyState, t_s: float) -> RateCommand:
        """Thrust and rates for this state; as ``Expert.sticks``."""
        ned_from_body = integrate(body.ned_from_body_wxyz, body.rate_body_radps, RATE_LAG_S)
        state = _predict_free(body, RATE_LAG_S)
        demand = self._guide.demand(body.position_ned_m, t_s, state)
        return rate_command(demand, state, ned_from_body, _drag_ned_mps2(body))


def _drag_ned_mps2(body: BodyState) -> Vec3:
    """Drag over mass, whatever the airframe and the wind; 0 on the ground.

    The thrust is along the body's third axis: what an accelerometer feels along the others is drag.
    """
    if body.touching:
        return (0.0, 0.0, 0.0)
    drag_x, drag_y, _ = body.specific_force_body_mps2
    return rotate(body.ned_from_body_wxyz, (drag_x, drag_y, 0.0))


def _predict_level(body: BodyState, drag_ned_mps2: Vec3, lag_s: float) -> Predicted:
    """Extrapolate by the lag, with the acceleration of the present lean in level flight."""
    thrust_n, thrust_e, thrust_d = rotate(body.ned_from_body_wxyz, (0.0, 0.0, -1.0))
    per_g = GRAVITY_MPS2 / max(0.5, -thrust_d)
    velocity_n, velocity_e, velocity_d = body.velocity_ned_mps
    accel_n = thrust_n * per_g + drag_ned_mps2[0]
    accel_e = thrust_e * per_g + drag_ned_mps2[1]
    half = lag_s * lag_s / 2
    north_m, east_m, down_m = body.position_ned_m
    _, _, yaw = to_euler(body.ned_from_body_wxyz)
    return Predicted(
        position_ned_m=(
            north_m + velocity_n * lag_s + accel_n * half,
            east_m + velocity_e * lag_s + accel_e * half,
            down_m + velocity_d * lag_s,
        ),
        velocity_ned_mps=(velocity_n + accel_n * lag_s, velocity_e + accel_e * lag_s, velocity_d),
        yaw_rad=wrap_pi(yaw + body.rate_body_radps[2] * lag_s),
    )


def _predict_free(body: BodyState, lag_s: float) -> Predicted:
    """Extrapolate by the lag, with the present specific force."""
    force_n, force_e, force_d = rotate(body.ned_from_body_wxyz, body.specific_force_body_mps2)
    accel_mps2 = (force_n, force_e, force_d + GRAVITY_MPS2)
    half = lag_s * lag_s / 2
    north, east, down = (
        (place + speed * lag_s + accel * half, speed + accel * lag_s)
        for place, speed, accel in zip(
            body.position_ned_m, body.velocity_ned_mps, accel_mps2, strict=True
        )
    )
    _, _, yaw = to_euler(body.ned_from_body_wxyz)
    return Predicted(
        position_ned_m=(north[0], east[0], down[0]),
        velocity_ned_mps=(north[1], east[1], down[1]),
        yaw_rad=wrap_pi(yaw + body.rate_body_radps[2] * lag_s),
    )
