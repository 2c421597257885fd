"""The expert by body rates: races on both firmwares."""

from collections.abc import Callable

from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.params import ArduPilotParams
from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.course import RACE_SEEDS, Course, make_course
from sitl.pilot.course_guide import CourseGuide
from sitl.pilot.demonstrator import HOVER_THRUST, RATE_AGILITY, RateCommand, expert_rates
from sitl.pilot.disturbance import RATE_STRENGTHS, Disturbance, random_start
from sitl.px4.autopilot import Px4
from sitl.px4.control import HOVER_THRUST as PX4_HOVER_THRUST
from sitl.px4.modes import Px4Mode
from sitl.px4.params import Px4Params
from sitl.report import FlightLog
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.firmware import AttitudeSetpoint
from sitl.vehicle.rotation import cos_tilt

TICK_NS = 10 * NS_PER_MS
READY = VehicleConfig(estimator_ready_s=0.0, position_ready_s=0.0)


def fly(
    course: Course,
    guide: CourseGuide,
    ap: ArduCopter | Px4,
    send: Callable[[RateCommand], None],
    disturbance: Disturbance,
) -> FlightLog:
    log = FlightLog(ap.now_ns, course)
    if not ap.landed:
        log.start_over(guide.next_gate or 0)
    due_ns = ap.now_ns
    while log.verdict(ap.now_ns) is None and ap.now_ns < 40 * NS_PER_S:
        if ap.now_ns >= due_ns:
            due_ns += TICK_NS
            wanted = expert_rates(guide, ap.truth, ap.now_ns / NS_PER_S)
            send(disturbance.flown(wanted, ap.now_ns / NS_PER_S))
        ap.step()
        log.on_step(ap)
    return log


def test_it_flies_on_from_the_air_and_against_disturbances_on_ardupilot() -> None:
    course = make_course(RACE_SEEDS + 7)
    start = random_start(course, 11, speed_mps=9.0)
    params = ArduPilotParams()
    params.set("GUID_OPTIONS", 8)
    ap = ArduCopter(params, READY, 0)
    for _ in range(50):
        ap.step()
    assert ap.set_mode(Mode.GUIDED_NOGPS)
    assert ap.arm(force=False), ap.texts
    ap.launch(start.position_ned_m, start.velocity_ned_mps, start.ned_from_body_wxyz)
    assert ap.mode is Mode.GUIDED_NOGPS

    def send(flown: RateCommand) -> None:
        lean = cos_tilt(ap.sensed.ned_from_body_wxyz)
        setpoint = AttitudeSetpoint(None, flown[1:], flown.thrust * lean)
        ap.guided and ap.guided.follow_attitude(setpoint, ap.sensed, ap.now_ns)

    guide = CourseGuide(course, RATE_AGILITY, 9.0, start.next_gate)
    disturbance = Disturbance(5, from_ground=False, strengths=RATE_STRENGTHS)
    log = fly(course, guide, ap, send, disturbance)
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
    ap.intended = Px4Mode.OFFBOARD
    ap.step()
    assert ap.arm(), ap.texts
    guide = CourseGuide(course, RATE_AGILITY, 8.0)
    log = fly(course, guide, ap, send, Disturbance(0, strength=0.0))
    assert not log.crashed
    assert log.next_gate is None
