"""Axes of pitch and roll in Simple and Super Simple mode, and how they change."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.params import ArduPilotParams
from sitl.ardupilot.sticks import Axes, SimpleMode, Sticks

FORWARD = Sticks(roll=0.0, pitch=-1.0, yaw=0.0, throttle=500.0, throttle_mid=500.0)
EAST = math.pi / 2
HERE, NORTH_30_M = (0.0, 0.0, -3.0), (30.0, 0.0, -3.0)
ALL_POSITIONS = 63.0


def simple(**params):
    store = ArduPilotParams()
    for name, value in params.items():
        assert store.set(name, value)
    return SimpleMode(store)


@pytest.mark.parametrize(
    ("params", "position", "axes"),
    [
        ({}, 4, Axes.VEHICLE),
        ({"SIMPLE": ALL_POSITIONS}, 4, Axes.ARMING),
        ({"SIMPLE": 8.0}, 4, Axes.ARMING),
        ({"SIMPLE": 8.0}, 5, Axes.VEHICLE),
        ({"SIMPLE": 8.0, "SUPER_SIMPLE": 8.0}, 4, Axes.HOME),
    ],
)
def test_each_position_of_the_mode_switch_has_its_bit(params, position, axes):
    mode = simple(**params)
    mode.read_mode_switch(position)
    assert mode.axes is axes


@pytest.mark.parametrize(
    ("option", "pwm_us", "axes"),
    [
        (3.0, 1000, Axes.VEHICLE),
        (3.0, 1900, Axes.ARMING),
        (13.0, 1500, Axes.ARMING),
        (13.0, 1900, Axes.HOME),
    ],
)
def test_a_switch_of_its_own_stands_for_the_mode_switch(option, pwm_us, axes):
    mode = simple(RC7_OPTION=option, SIMPLE=ALL_POSITIONS)
    mode.read_aux([1500] * 6 + [pwm_us, 0])
    mode.read_mode_switch(4)
    assert mode.axes is axes


def test_forward_is_where_the_nose_was_at_arming():
    mode = simple()
    mode.arm(0.0)
    assert mode.turned(FORWARD, EAST, HERE) == FORWARD
    mode.axes = Axes.ARMING
    turned = mode.turned(FORWARD, EAST, HERE)  # north is to the left of a nose to the east
    assert (turned.roll, turned.pitch) == pytest.approx((-1.0, 0.0), abs=1e-9)
    assert turned[2:] == FORWARD[2:]


def test_forward_is_away_from_home_in_super_simple_mode():
    mode = simple()
    mode.arm(EAST)
    mode.axes = Axes.HOME
    near, far = mode.turned(FORWARD, EAST, HERE), mode.turned(FORWARD, EAST, NORTH_30_M)
    assert (near.roll, near.pitch) == pytest.approx((0.0, -1.0), abs=1e-9)
    assert (far.roll, far.pitch) == pytest.approx((-1.0, 0.0), abs=1e-9)


def test_a_parameter_alone_changes_nothing_and_a_command_does(station):
    station.vehicle.params.set("SIMPLE", ALL_POSITIONS)
    station.run(1.0)
    ap = station.vehicle.ap
    assert ap.simple.axes is Axes.ARMING
    station.vehicle.params.set("SIMPLE", 0.0)
    station.run(1.0)
    assert ap.simple.axes is Axes.ARMING

    assert station.command(mav.MAV_CMD_DO_AUX_FUNCTION, 3, 0) == mav.MAV_RESULT_ACCEPTED
    assert ap.simple.axes is Axes.VEHICLE
    assert station.command(mav.MAV_CMD_DO_AUX_FUNCTION, 9, 2) == mav.MAV_RESULT_FAILED
