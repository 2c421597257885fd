"""The demonstrator over whole courses in stepped time: a few of them."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.course_flights import fly_course
from sitl import UsageError
from sitl.camera.fpv import body_from_camera
from sitl.course import AirborneStart, gate_truth, make_course
from sitl.expert.course_guide import Waypoint, least_acceleration
from sitl.expert.demonstrator import Expert
from sitl.expert.disturbance import Disturbance, random_start
from sitl.rotation import IDENTITY, from_euler
from sitl.vehicle.conditions import NOMINAL, random_conditions
from sitl.vehicle.dynamics import Quadrotor


@pytest.fixture(scope="module")
def nominal_flight():
    return fly_course(make_course(3), 6.0)


def test_it_takes_off_passes_every_gate_near_the_middle_and_hovers(nominal_flight):
    flight = nominal_flight
    passed = flight.vehicle.log.summary(flight.vehicle.ap, 0)["gates"]["passed"]
    assert [entry["index"] for entry in passed] == list(range(8))
    assert not flight.vehicle.log.crashed
    assert max(flight.misses_m()) < 0.5
    assert math.hypot(*flight.vehicle.ap.truth.velocity_ned_mps) < 1.0
    assert 5.0 < flight.mean_speed_mps() < 6.3


def test_the_sticks_are_smooth(nominal_flight):
    """Total travel per second, and the largest step between two ticks of 10 ms."""
    steps = np.abs(np.diff(nominal_flight.labels, axis=0))
    assert (steps.mean(axis=0) * 100 < (0.5, 0.3, 0.5, 0.8)).all()
    assert steps.max() < 0.25
    assert np.abs(nominal_flight.labels).max() <= 1.0


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


def test_what_it_holds_depends_on_the_present_alone(nominal_flight):
    for tick in nominal_flight.ticks[50:-320:40]:
        fresh = Expert(nominal_flight.course, 6.0, next_gate=tick.next_gate)
        assert tick.label == fresh.sticks(tick.pose.body, 0.0)


def test_it_flies_another_vehicle_in_wind_with_a_bad_thumb():
    disturbance = Disturbance(5)
    flight = fly_course(
        make_course(5), 5.0, conditions=random_conditions(5), disturbance=disturbance
    )
    assert flight.succeeded
    assert any(tick.flown != tick.label for tick in flight.ticks)


def test_it_leans_against_the_drag_of_any_airframe():
    heavy = replace(NOMINAL, min_rotor_drag_nspm=0.8)
    flight = fly_course(make_course(3), 5.0, conditions=heavy)
    assert flight.succeeded
    assert flight.mean_speed_mps() > 4.0


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


def test_it_takes_over_in_the_air():
    course = make_course(11)
    assert fly_course(course, 6.0, start=random_start(course, 11, speed_mps=6.0)).succeeded


@pytest.mark.parametrize("speed_mps", [0.0, 20.0, math.nan])
def test_a_speed_it_cannot_fly_at_is_refused(speed_mps):
    with pytest.raises(UsageError, match=r"1\.5 to 10\.0 m/s"):
        Expert(make_course(0), speed_mps)


def test_least_acceleration_is_none_where_none_is_needed():
    waypoints = [
        Waypoint(point_m=(6.0 * k, 0.0, -2.0), velocity_mps=(6.0, 0.0, 0.0), leg_s=1.0)
        for k in (1, 2)
    ]
    plan = least_acceleration((0.0, 0.0, -2.0), (6.0, 0.0, 0.0), waypoints)
    np.testing.assert_allclose(plan.accel_mps2, 0.0, atol=1e-9)


@settings(max_examples=50, deadline=None)
@given(st.tuples(*[st.floats(-3.0, 3.0)] * 6))
def test_the_planned_path_is_the_best_of_its_neighbours(start):
    """The gradient of the cost at the waypoint, by hand."""
    waypoint = Waypoint(point_m=(5.0, 0.0, 0.0), velocity_mps=(5.0, 0.0, 0.0), leg_s=1.0)
    plan = least_acceleration(start[:3], start[3:], [waypoint])
    # At a free end the acceleration is the pull of the velocity's weight (costate of v, halved).
    wanted = -2.0 * (plan.velocity_mps[1] - waypoint.velocity_mps)
    np.testing.assert_allclose(plan.accel_mps2[1], wanted, atol=1e-6)


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


def test_disturbances_come_in_stretches_and_by_seed():
    def flown(seed):
        disturbance = Disturbance(seed)
        wanted = Expert(make_course(0), 5.0).sticks(Quadrotor().at_rest().body, 0.0)
        return [disturbance.flown(wanted, k / 100) != wanted for k in range(3000)]

    assert flown(3) == flown(3)
    assert flown(3) != flown(4)
    changes = sum(a != b for a, b in pairwise(flown(3)))
    assert 4 < changes < 60
    assert 0.1 < np.mean(flown(3)) < 0.7
    assert Disturbance(3, strength=0.0).flown((0.9, 0, 0, 0), 9.0) == (0.9, 0, 0, 0)
