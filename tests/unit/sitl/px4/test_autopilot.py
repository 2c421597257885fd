"""The PX4 vehicle without its link: airborne start, its airframe, position."""

import math
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.course import AirborneStart
from sitl.px4.modes import Px4Mode
from sitl.vehicle.rotation import from_euler

MID = (0, 0, 500, 0)
START = AirborneStart(
    position_ned_m=(0.0, 0.0, -10.0), ned_from_body_wxyz=from_euler(0.0, 0.0, 0.5)
)


@pytest.fixture
def airborne(ends):
    ends.run(0.1)
    ends.vehicle.launch(START)
    return ends


def test_a_launch_under_sticks_leaves_them(ends):
    """Otherwise the vehicle would report sticks that were never sent."""
    ends.run(0.2, {0: (0, 300, 500, 0)})
    ends.vehicle.launch(START)
    assert ends.ap.stick_input.sticks.right == pytest.approx(0.3)
    ends.run(0.6)
    assert not ends.ap.stick_input.valid


def test_a_lost_position_leaves_posctl_for_altctl_and_gives_it_back(airborne):
    airborne.run(0.2, {0: MID})
    assert airborne.command(mav.MAV_CMD_DO_SET_MODE, 1, 3) == mav.MAV_RESULT_ACCEPTED
    airborne.ap.position_lost = True
    airborne.run(0.2, {0: MID})
    assert airborne.ap.mode is Px4Mode.ALTCTL
    assert airborne.ap.intended is Px4Mode.POSCTL
    refused = airborne.command(mav.MAV_CMD_DO_SET_MODE, 1, 4, 3)
    assert refused == mav.MAV_RESULT_TEMPORARILY_REJECTED
    airborne.ap.position_lost = False
    airborne.run(0.2, {0: MID})
    assert airborne.ap.mode is Px4Mode.POSCTL


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("MAN_DEADZONE", 1.0),
        ("MPC_ACC_HOR", 0.0),
        ("MPC_JERK_AUTO", -1.0),
        ("MPC_VEL_MANUAL", 0.0),
        ("MPC_XY_CRUISE", 0.0),
    ],
)
def test_a_parameter_that_leaves_no_motion_does_not_end_the_simulator(airborne, name, value):
    airborne.vehicle.params.set(name, value)
    for mode in ((3, 0), (4, 3), (3, 0)):
        airborne.run(0.2, {0: MID})
        assert airborne.command(mav.MAV_CMD_DO_SET_MODE, 1, *mode) == mav.MAV_RESULT_ACCEPTED
        airborne.run(0.5, {0: MID})
        airborne.run(0.1, {0: (500, 0, 500, 300)})
    assert airborne.ap.mode is Px4Mode.POSCTL


def test_a_return_climbs_flies_home_lands_and_disarms(ends):
    ends.run(0.1)
    ends.vehicle.launch(replace(START, position_ned_m=(20.0, 0.0, -10.0)))
    ends.run(0.2, {0: MID})
    assert ends.command(mav.MAV_CMD_DO_SET_MODE, 1, 4, 5) == mav.MAV_RESULT_ACCEPTED
    highest_m = 0.0
    for _ in range(120):
        ends.run(1.0)  # a return goes on without sticks
        assert not ends.ap.in_failsafe
        highest_m = max(highest_m, -ends.ap.truth.position_ned_m[2])
        if not ends.ap.armed:
            break
    north, east, _ = ends.ap.truth.position_ned_m
    assert highest_m == pytest.approx(30.0, abs=1.5)
    assert math.hypot(north, east) < 1.5
    assert not ends.ap.armed
