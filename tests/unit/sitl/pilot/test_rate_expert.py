"""The expert by body rates: its commands, and races on both firmwares."""

import math
from collections.abc import Callable

import pytest

from sitl import UsageError
from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.control import boosted
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.params import ArduPilotParams
from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.course import RACE_SEEDS, AirborneStart, Course, make_course
from sitl.pilot.demonstrator import HOVER_THRUST, RateCommand, RateExpert
from sitl.pilot.disturbance import RATE_STRENGTHS, Disturbance, random_start
from sitl.px4.autopilot import Px4
from sitl.px4.control import HOVER_THRUST as PX4_HOVER_THRUST
from sitl.px4.modes import Px4Mode
from sitl.px4.params import Px4Params
from sitl.report import FlightLog
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.dynamics import BodyState
from sitl.vehicle.firmware import AttitudeSetpoint
from sitl.vehicle.rotation import cos_tilt, from_euler

TICK_NS = 10 * NS_PER_MS
READY = VehicleConfig(estimator_ready_s=0.0, position_ready_s=0.0)


def body(**changes: object) -> BodyState:
    hovering = BodyState(
        position_ned_m=(0.0, 0.0, -3.0),
        ned_from_body_wxyz=(1.0, 0.0, 0.0, 0.0),
        velocity_ned_mps=(0.0, 0.0, 0.0),
        rate_body_radps=(0.0, 0.0, 0.0),
        specific_force_body_mps2=(0.0, 0.0, -9.80665),
        motors=(0.39,) * 4,
        touching=False,
    )
    return hovering._replace(**changes)  # type: ignore[arg-type]


def command(**changes: object) -> RateCommand:
    return RateExpert(make_course(RACE_SEEDS), 6.0).command(body(**changes), 0.0)


def test_drag_is_read_off_the_accelerometer_not_assumed() -> None:
    """A heavier drag from ahead asks for more lean into it."""
    light = command(velocity_ned_mps=(6.0, 0.0, 0.0))
    heavy = command(
        velocity_ned_mps=(6.0, 0.0, 0.0), specific_force_body_mps2=(-3.0, 0.0, -9.80665)
    )
    assert abs(light.pitch_radps) < 1.5
    assert heavy.pitch_radps < light.pitch_radps - 1.5


@pytest.mark.parametrize("speed_mps", [1.0, 15.0])
def test_a_speed_that_it_cannot_fly_is_refused(speed_mps: float) -> None:
    with pytest.raises(UsageError, match=r"1\.5 to 14"):
        RateExpert(make_course(RACE_SEEDS), speed_mps)


def fly(
    course: Course,
    expert: RateExpert,
    ap: ArduCopter | Px4,
    send: Callable[[RateCommand], None],
    disturbance: Disturbance,
) -> FlightLog:
    log = FlightLog(ap.now_ns, course)
    if not ap.landed:
        log.start_over(expert.next_gate or 0)
    due_ns = ap.now_ns
    while log.verdict(ap.now_ns) is None and ap.now_ns < 40 * NS_PER_S:
        if ap.now_ns >= due_ns:
            due_ns += TICK_NS
            wanted = expert.command(ap.truth, ap.now_ns / NS_PER_S)
            send(disturbance.flown(wanted, ap.now_ns / NS_PER_S))
        ap.step()
        log.on_step(ap)
    return log


def fly_ardupilot(
    course: Course, speed_mps: float, *, start: AirborneStart | None = None, strength: float = 0.0
) -> FlightLog:
    params = ArduPilotParams()
    params.set("GUID_OPTIONS", 8)
    ap = ArduCopter(params, READY, 0)
    for _ in range(50):
        ap.step()
    assert ap.set_mode(Mode.GUIDED_NOGPS)
    assert ap.arm(force=False), ap.texts
    if start is not None:
        ap.launch(start.position_ned_m, start.velocity_ned_mps, start.ned_from_body_wxyz)
        assert ap.mode is Mode.GUIDED_NOGPS

    def send(flown: RateCommand) -> None:
        lean = cos_tilt(ap.sensed.ned_from_body_wxyz)
        setpoint = AttitudeSetpoint(None, flown[1:], flown.thrust * lean)
        ap.guided and ap.guided.follow_attitude(setpoint, ap.sensed, ap.now_ns)

    expert = RateExpert(course, speed_mps, next_gate=start.next_gate if start else 0)
    disturbance = Disturbance(5, strength=strength, from_ground=False, strengths=RATE_STRENGTHS)
    return fly(course, expert, ap, send, disturbance)


@pytest.mark.parametrize("seed", [3, 14])
def test_it_flies_a_race_on_ardupilot(seed: int) -> None:
    log = fly_ardupilot(make_course(RACE_SEEDS + seed), 10.0)
    assert not log.crashed
    assert log.next_gate is None
    first, *_, last = log.gates_passed
    assert last.t_s - first.t_s < 18.0  # 11 legs of 10 to 16 m


def test_it_flies_on_from_the_air_and_against_disturbances() -> None:
    course = make_course(RACE_SEEDS + 7)
    start = random_start(course, 11, speed_mps=9.0)
    log = fly_ardupilot(course, 9.0, start=start, strength=1.0)
    assert not log.crashed
    assert log.next_gate is None


def test_it_flies_a_race_on_px4_with_its_heavy_drag() -> None:
    course = make_course(RACE_SEEDS + 3)
    ap = Px4(Px4Params(), READY, 0)

    def send(flown: RateCommand) -> None:
        thrust = flown.thrust * PX4_HOVER_THRUST / HOVER_THRUST
        ap.set_setpoint(AttitudeSetpoint(None, flown[1:], min(1.0, thrust)), ap.now_ns)

    for _ in range(50):
        ap.step()
    send(RateCommand(0.0, 0.0, 0.0, 0.0))
    ap.commander.intended = Px4Mode.OFFBOARD
    ap.step()
    assert ap.commander.arm(), ap.texts
    log = fly(course, RateExpert(course, 8.0), ap, send, Disturbance(0, strength=0.0))
    assert not log.crashed
    assert log.next_gate is None


def test_ardupilot_boosts_the_thrust_of_a_lean_to_84_degrees() -> None:
    params = ArduPilotParams()
    for lean_deg, factor in ((0.0, 1.0), (60.0, 2.0), (80.0, 1 / math.cos(math.radians(80)))):
        leaning = body(ned_from_body_wxyz=from_euler(math.radians(lean_deg), 0.0, 0.0))
        assert boosted(0.1, leaning, params) == pytest.approx(0.1 * factor)
    upside_down = body(ned_from_body_wxyz=from_euler(math.pi, 0.0, 0.0))
    assert boosted(0.1, upside_down, params) == 0.0
