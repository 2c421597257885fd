"""Flies gate courses in stepped time: vehicle and expert without a link in between."""

import math
from dataclasses import dataclass
from itertools import pairwise

from sitl.ardupilot.flight_modes import Mode
from sitl.clock import NS_PER_S
from sitl.course import AirborneStart, Course
from sitl.pilot.course_guide import CourseGuide
from sitl.pilot.demonstrator import STICK_AGILITY, StickPositions, expert_sticks
from sitl.simulated_vehicle import Pose, SimulatedVehicle
from sitl.vehicle.config import STEP_NS, VehicleConfig

TICK_NS = NS_PER_S // 100
REST_S = 3.0
"""Flight time after the last gate."""
LIMIT_S = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    pose: Pose
    next_gate: int | None


@dataclass(frozen=True, slots=True, kw_only=True)
class CourseFlight:
    course: Course
    vehicle: SimulatedVehicle
    ticks: list[Tick]

    @property
    def succeeded(self) -> bool:
        return self.vehicle.log.next_gate is None and not self.vehicle.log.crashed

    def mean_speed_mps(self) -> float:
        """Return the speed along the straight legs between the first and the last passed gate."""
        passed = self.vehicle.log.summary(self.vehicle.ap)["gates"]["passed"]
        centers = [self.course.gates[entry["index"]].center_ned_m for entry in passed]
        distance_m = sum(math.dist(a, b) for a, b in pairwise(centers))
        return distance_m / (passed[-1]["t_s"] - passed[0]["t_s"]) if len(passed) > 1 else math.nan

    def misses_m(self) -> list[float]:
        """Return the larger of sideways and vertical distance to the centre at each passed gate."""
        misses = []
        for before, after in pairwise(self.ticks):
            if after.next_gate != before.next_gate:
                gate = self.course.gates[before.next_gate]
                _, right_m, down_m = gate.offset_m(after.pose.body.position_ned_m)
                misses.append(max(abs(right_m), abs(down_m)))
        return misses


def pwm_us(sticks: StickPositions) -> list[int]:
    """Return RC_CHANNELS_OVERRIDE of the default calibration; pitch is reversed."""
    throttle, yaw, pitch, roll = sticks
    axes = (roll, -pitch, throttle, yaw)
    return [round(1500 + 500 * axis) for axis in axes] + [65535] * 4


def fly_course(
    course: Course,
    speed_mps: float,
    *,
    start: AirborneStart | None = None,
) -> CourseFlight:
    config = VehicleConfig(estimator_ready_s=0.0, position_ready_s=0.0)
    vehicle = SimulatedVehicle(links=1, boot_ns=0, config=config, course=course)
    if start is None:
        vehicle.step(50 * STEP_NS)
        assert vehicle.ap.set_mode(Mode.ALT_HOLD)
        assert vehicle.ap.arm(force=False), vehicle.ap.texts
    else:
        vehicle.launch(start)
    next_gate = start.next_gate if start else 0
    guide = CourseGuide(course, STICK_AGILITY, speed_mps, next_gate)
    ticks: list[Tick] = []
    over_ns = None
    begin_ns = now_ns = vehicle.ap.now_ns
    while not vehicle.log.crashed and now_ns - begin_ns < LIMIT_S * NS_PER_S:
        pose, next_gate = vehicle.pose, vehicle.log.next_gate
        if next_gate is None:
            over_ns = over_ns or now_ns + round(REST_S * NS_PER_S)
            if now_ns >= over_ns:
                break
        body, t_s = pose.body, now_ns / NS_PER_S
        ticks.append(Tick(pose=pose, next_gate=next_gate))
        vehicle.ap.rc.override(pwm_us(expert_sticks(guide, body, t_s)), now_ns)
        now_ns += TICK_NS
        vehicle.step(now_ns)
    return CourseFlight(course=course, vehicle=vehicle, ticks=ticks)
