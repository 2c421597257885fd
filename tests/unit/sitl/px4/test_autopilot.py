"""The PX4 vehicle without its link: airborne start, budget of failsafes, its airframe, position."""

import math
from dataclasses import replace

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.course import AirborneStart
from sitl.px4.modes import Mode, mode_of
from sitl.rotation import from_euler

MID = (0, 0, 500, 0)
START = AirborneStart(
    position_ned_m=(0.0, 0.0, -10.0),
    velocity_ned_mps=(0.0, 0.0, 0.0),
    ned_from_body_wxyz=from_euler(0.0, 0.0, 0.5),
    next_gate=0,
)


@pytest.fixture
def airborne(ends):
    ends.run(0.1)
    ends.vehicle.launch(START)
    return ends


def lean_deg(ends):
    _, x, y, _ = ends.ap.truth.ned_from_body_wxyz
    return math.degrees(math.acos(1.0 - 2.0 * (x * x + y * y)))


def test_a_launched_vehicle_hovers_in_altctl_until_sticks_come(airborne):
    airborne.run(3.0)

    assert (airborne.ap.mode_name, airborne.ap.armed, airborne.ap.landed) == (
        "ALTCTL", True, False,
    )  # fmt: skip
    assert airborne.ap.truth.position_ned_m == pytest.approx((0, 0, -10.0), abs=0.3)
    assert not airborne.ap.in_failsafe


def test_a_launched_vehicle_misses_the_sticks_that_came_and_stopped(airborne):
    airborne.run(0.5, {0: MID})
    airborne.run(0.9)

    assert airborne.ap.mode is Mode.AUTO_LOITER
    assert airborne.ap.in_failsafe


def test_a_launch_under_sticks_leaves_them(ends):
    """Else the vehicle would show sticks that nobody has sent."""
    ends.run(0.2, {0: (0, 300, 500, 0)})
    ends.vehicle.launch(START)

    assert ends.ap.stick_input.sticks.right == pytest.approx(0.3)
    ends.run(0.6)
    assert not ends.ap.stick_input.valid


def test_its_speed_ends_where_drag_holds_the_lean(airborne):
    airborne.run(6.0, {0: (0, 1000, 500, 0)})

    assert lean_deg(airborne) == pytest.approx(35.0, abs=0.5)
    assert math.hypot(*airborne.ap.truth.velocity_ned_mps) == pytest.approx(6.8, abs=0.3)


def test_the_delay_of_a_failsafe_comes_back_at_a_quarter(airborne):
    airborne.run(0.5, {0: MID})
    airborne.run(5.0)
    lost = airborne.ap.commander.lost_sticks
    spent_s = 5.0 - lost.delay_s
    airborne.command(mav.MAV_CMD_DO_SET_MODE, 1, 4, 3)
    before_s = lost.delay_s

    airborne.run(8.0)

    assert spent_s == pytest.approx(4.4, abs=0.1)
    assert lost.delay_s - before_s == pytest.approx(2.0, abs=0.05)


def test_a_lost_position_leaves_posctl_for_altctl_and_gives_it_back(airborne):
    airborne.run(0.2, {0: MID})
    assert airborne.command(mav.MAV_CMD_DO_SET_MODE, 1, 3) == mav.MAV_RESULT_ACCEPTED
    airborne.ap.position_lost = True
    airborne.run(0.2, {0: MID})

    assert airborne.ap.mode is Mode.ALTCTL
    assert airborne.ap.commander.intended is Mode.POSCTL
    refused = airborne.command(mav.MAV_CMD_DO_SET_MODE, 1, 4, 3)
    assert refused == mav.MAV_RESULT_TEMPORARILY_REJECTED
    airborne.ap.position_lost = False
    airborne.run(0.2, {0: MID})
    assert airborne.ap.mode is Mode.POSCTL


def test_a_return_climbs_flies_home_lands_and_disarms(ends):
    ends.run(0.1)
    ends.vehicle.launch(replace(START, position_ned_m=(20.0, 0.0, -10.0)))
    ends.run(0.2, {0: MID})
    assert ends.command(mav.MAV_CMD_NAV_RETURN_TO_LAUNCH) == mav.MAV_RESULT_ACCEPTED
    highest_m = 0.0
    for _ in range(120):
        ends.run(1.0, {0: MID})
        highest_m = max(highest_m, -ends.ap.truth.position_ned_m[2])
        if not ends.ap.armed:
            break

    north, east, _ = ends.ap.truth.position_ned_m
    assert highest_m == pytest.approx(30.0, abs=1.5)
    assert math.hypot(north, east) < 1.5
    assert not ends.ap.armed


@pytest.mark.parametrize(
    ("numbers", "mode"),
    [
        ((2, 0), Mode.ALTCTL),
        ((3, 1), Mode.POSCTL),
        ((4, 0), Mode.AUTO_MISSION),
        ((4, 99), None),
        ((9, 0), None),
    ],
)
def test_modes_by_number(numbers, mode):
    assert mode_of(*numbers) is mode


@pytest.mark.parametrize(
    ("mode", "flags"),
    [
        (Mode.ALTCTL, 81),
        (Mode.STAB, 81),
        (Mode.MANUAL, 81),
        (Mode.ACRO, 65),
        (Mode.AUTO_LOITER, 29),
        (Mode.OFFBOARD, 1),
    ],
)
def test_base_mode_of_the_heartbeat(mode, flags):
    assert mode.base_flags == flags
