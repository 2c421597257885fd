"""The demonstrator over whole courses in stepped time: a few of them."""

import math

import pytest

from helpers.course_flights import fly_course
from sitl import UsageError
from sitl.camera.fpv import body_from_camera
from sitl.course import AirborneStart, gate_truth, make_course
from sitl.pilot.course_guide import CourseGuide
from sitl.pilot.demonstrator import RATE_AGILITY, STICK_AGILITY
from sitl.vehicle.rotation import IDENTITY, from_euler


@pytest.fixture(scope="module")
def nominal_flight():
    return fly_course(make_course(3), 6.0)


def test_it_takes_off_passes_every_gate_near_the_middle_and_hovers(nominal_flight):
    flight = nominal_flight
    passed = flight.vehicle.log.summary(flight.vehicle.ap)["gates"]["passed"]
    assert [entry["index"] for entry in passed] == list(range(8))
    assert not flight.vehicle.log.crashed
    assert max(flight.misses_m()) < 0.5
    assert math.hypot(*flight.vehicle.ap.truth.velocity_ned_mps) < 1.0
    assert 5.0 < flight.mean_speed_mps() < 6.3


def test_the_next_gate_is_in_the_picture(nominal_flight):
    """Its centre, from the ground up to 2 m before it."""
    camera_from_body = body_from_camera().T
    for tick in nominal_flight.ticks[::10]:
        body = tick.pose.body
        if tick.next_gate is None:
            continue
        truth = gate_truth(
            nominal_flight.course, tick.next_gate, body.position_ned_m, body.ned_from_body_wxyz
        )
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
    assert fly_course(course, 5.0, start=start).succeeded


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
