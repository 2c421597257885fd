"""The map of the sticks follows the vehicle's mode and parameters."""

from collections import Counter

import pytest

from helpers.stick_curves import PX4_DEFAULTS, copter_values
from mavbridge.core.vehicle import StickGains, Sticks
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.profiles.stick_map import StickMap

STICKS = Sticks(throttle=0.9, yaw=0.5, pitch=0.5, roll=0.0)


def test_sticks_are_as_they_are_until_the_vehicle_is_known() -> None:
    stick_map = StickMap(PX4, StickGains())
    assert stick_map.to_vehicle(STICKS) is STICKS
    assert stick_map.to_policy(STICKS) is STICKS


def test_the_mode_and_the_parameters_count_as_they_change() -> None:
    stick_map = StickMap(ARDUPILOT, StickGains())
    stick_map.follow("ALT_HOLD", copter_values())
    assert stick_map.to_vehicle(STICKS) is STICKS
    stick_map.follow("ALT_HOLD", copter_values(PILOT_Y_RATE=405.0))
    moved = stick_map.to_vehicle(STICKS)
    assert moved == STICKS._replace(yaw=pytest.approx(0.27))
    assert stick_map.to_policy(moved) == pytest.approx(STICKS)
    stick_map.follow("LOITER", copter_values(PILOT_Y_RATE=405.0))
    assert stick_map.to_vehicle(STICKS) is STICKS


def test_each_limit_is_told_once_in_the_mode_that_has_it() -> None:
    stick_map = StickMap(PX4, StickGains())
    assert stick_map.follow("AUTO.LOITER", PX4_DEFAULTS) == ()
    (yaw,) = stick_map.follow("STABILIZED", PX4_DEFAULTS)
    assert "yaw rate" in yaw
    (descent,) = stick_map.follow("ALTCTL", PX4_DEFAULTS)
    assert "descent" in descent
    assert stick_map.follow("STABILIZED", PX4_DEFAULTS) == ()
    (changed,) = stick_map.follow("STABILIZED", PX4_DEFAULTS | {"MPC_MAN_Y_MAX": 120.0})
    assert "turns 120 deg/s" in changed


def test_what_saturates_is_counted() -> None:
    stick_map = StickMap(PX4, StickGains())
    stick_map.follow("ALTCTL", PX4_DEFAULTS)
    for yaw in (0.7, 0.8, -0.9):
        stick_map.to_vehicle(Sticks(throttle=-1.0, yaw=yaw, pitch=1.0, roll=0.0))
    assert stick_map.saturated == Counter(throttle=3, yaw=2)
    stick_map.follow("POSCTL", PX4_DEFAULTS)
    stick_map.to_vehicle(Sticks(throttle=-1.0, yaw=1.0, pitch=1.0, roll=0.0))
    assert stick_map.saturated == Counter(throttle=3, yaw=2)
