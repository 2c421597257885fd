"""The demonstrator over whole courses in stepped time: a few of them."""

import math
from itertools import pairwise

import pytest

from sitl import UsageError
from sitl.ardupilot.flight_modes import Mode
from sitl.camera.fpv import body_from_camera
from sitl.clock import NS_PER_S
from sitl.course import AirborneStart, gate_truth, make_course
from sitl.pilot.course_guide import CourseGuide
from sitl.pilot.demonstrator import RATE_AGILITY, STICK_AGILITY, expert_sticks
from sitl.simulated_vehicle import SimulatedVehicle
from sitl.vehicle.config import STEP_NS, VehicleConfig
from sitl.vehicle.rotation import IDENTITY, from_euler

COURSE = make_course(3)
TICK_NS = NS_PER_S // 100
REST_TICKS, MOST_TICKS = 300, 6000
"""Flight time after the last gate, and in all."""


def fly(course, speed_mps, start=None):
    """Fly a course; return the vehicle, and its body and next gate at every tick."""
    config = VehicleConfig(estimator_ready_s=0.0, position_ready_s=0.0)
    vehicle = SimulatedVehicle(links=1, boot_ns=0, config=config, course=course)
    if start is None:
        vehicle.step(50 * STEP_NS)
        assert vehicle.ap.set_mode(Mode.ALT_HOLD)
        assert vehicle.ap.arm(force=False), vehicle.ap.texts
    else:
        vehicle.launch(start)
    guide = CourseGuide(course, STICK_AGILITY, speed_mps, start.next_gate if start else 0)
    ticks, now_ns = [], vehicle.ap.now_ns
    while not vehicle.log.crashed and len(ticks) < MOST_TICKS:
        body = vehicle.pose.body
        ticks.append((body, vehicle.log.next_gate))
        if len(ticks) > REST_TICKS and ticks[-REST_TICKS][1] is None:
            break
        throttle, yaw, pitch, roll = expert_sticks(guide, body, now_ns / NS_PER_S)
        sticks_us = [round(1500 + 500 * axis) for axis in (roll, -pitch, throttle, yaw)]
        vehicle.ap.rc.override([*sticks_us, *[65535] * 4], now_ns)
        now_ns += TICK_NS
        vehicle.step(now_ns)
    return vehicle, ticks


@pytest.fixture(scope="module")
def nominal_flight():
    return fly(COURSE, 6.0)


def test_it_takes_off_passes_every_gate_near_the_middle_and_hovers(nominal_flight):
    vehicle, ticks = nominal_flight
    passed = vehicle.log.summary(vehicle.ap)["gates"]["passed"]
    assert [entry["index"] for entry in passed] == list(range(8))
    assert not vehicle.log.crashed
    for (_, before), (body, after) in pairwise(ticks):
        if after != before:
            _, right_m, down_m = COURSE.gates[before].offset_m(body.position_ned_m)
            assert max(abs(right_m), abs(down_m)) < 0.5
    assert math.hypot(*vehicle.ap.truth.velocity_ned_mps) < 1.0
    legs_m = [math.dist(a.center_ned_m, b.center_ned_m) for a, b in pairwise(COURSE.gates)]
    assert 5.0 < sum(legs_m) / (passed[-1]["t_s"] - passed[0]["t_s"]) < 6.3


def test_the_next_gate_is_in_the_picture(nominal_flight):
    """Its centre, from the ground up to 2 m before it."""
    camera_from_body = body_from_camera().T
    for body, next_gate in nominal_flight[1][::10]:
        if next_gate is None:
            continue
        truth = gate_truth(COURSE, next_gate, body.position_ned_m, body.ned_from_body_wxyz)
        if math.hypot(*truth.gate_body_m) > 2.0:
            right, down, ahead = camera_from_body @ truth.gate_body_m
            assert max(abs(right), abs(down)) < ahead


@pytest.mark.parametrize(
    ("axial_m", "right_m"),
    [pytest.param(2.0, 2.2, id="behind"), pytest.param(-0.6, -3.5, id="beside")],
)
def test_a_missed_gate_is_flown_at_again(axial_m, right_m):
    course = make_course(2)
    gate = course.gates[6]
    cos_yaw, sin_yaw = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
    north_m, east_m, down_m = gate.center_ned_m
    start = AirborneStart(
        position_ned_m=(
            north_m + axial_m * cos_yaw - right_m * sin_yaw,
            east_m + axial_m * sin_yaw + right_m * cos_yaw,
            down_m,
        ),
        velocity_ned_mps=(2.0 * cos_yaw, 2.0 * sin_yaw, 0.0),
        ned_from_body_wxyz=from_euler(0.0, 0.0, gate.yaw_rad),
        next_gate=6,
    )
    assert gate.offset_m(start.position_ned_m) == pytest.approx((axial_m, right_m, 0.0))
    vehicle, _ = fly(course, 5.0, start)
    assert (vehicle.log.next_gate, vehicle.log.crashed) == (None, False)


@pytest.mark.parametrize(
    ("agility", "speed_mps", "most"),
    [
        *((STICK_AGILITY, speed_mps, "10.0") for speed_mps in (0.0, 20.0, math.nan)),
        *((RATE_AGILITY, speed_mps, "14") for speed_mps in (1.0, 15.0)),
    ],
)
def test_a_speed_it_cannot_fly_at_is_refused(agility, speed_mps, most):
    with pytest.raises(UsageError, match=f"1.5 to {most}"):
        CourseGuide(make_course(0), agility, speed_mps)


def test_truth_by_hand():
    course = make_course(7)
    first, second = course.gates[:2]
    truth = gate_truth(course, 0, (2.0, 1.0, -1.0), from_euler(0.0, 0.0, math.pi / 2))
    assert truth.gate_body_m == pytest.approx((-1.0, -6.0, first.center_ned_m[2] + 1.0))
    assert truth.gate_yaw_rad == pytest.approx(first.yaw_rad - math.pi / 2)
    north, east, down = second.center_ned_m
    assert truth.gate_after_body_m == pytest.approx((east - 1.0, 2.0 - north, down + 1.0))
    assert gate_truth(course, 7, (0.0, 0.0, 0.0), IDENTITY).gate_after_body_m is None
    assert gate_truth(course, None, (0.0, 0.0, 0.0), IDENTITY).gate_body_m is None
