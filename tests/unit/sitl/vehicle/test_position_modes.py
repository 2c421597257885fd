"""BRAKE, LOITER and POSHOLD: stopping, staying, what the sticks do, and the position they need."""

import math
from dataclasses import replace

import pytest

from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.conditions import NOMINAL
from sitl.vehicle.config import VehicleConfig

HOLDING = (Mode.BRAKE, Mode.LOITER, Mode.POSHOLD)
PILOTED = (Mode.LOITER, Mode.POSHOLD)


@pytest.mark.parametrize("mode", HOLDING)
def test_it_stops_and_stays_there_in_the_wind(pilot, mode):
    windy = replace(NOMINAL, wind_ned_mps=(4.0, 0.0, 0.0), gust_rms_mps=0.5)
    pilot = type(pilot)(VehicleConfig(conditions=windy))
    pilot.take_off()
    pilot.hold(1.5, roll=1750)
    start_m = pilot.height_m
    assert math.hypot(*pilot.ap.truth.velocity_ned_mps) > 2.0
    assert pilot.ap.set_mode(mode)

    pilot.hold(5.0)
    stopped_ned_m = pilot.ap.truth.position_ned_m
    pilot.hold(20.0)

    assert math.dist(pilot.ap.truth.position_ned_m, stopped_ned_m) < 0.3
    assert pilot.height_m == pytest.approx(start_m, abs=0.3)


def test_without_a_position_it_is_refused_in_the_air(pilot):
    pilot = type(pilot)(VehicleConfig(position_ready_s=math.inf))
    pilot.take_off()

    for mode in (*HOLDING, Mode.RTL):
        assert not pilot.ap.set_mode(mode)
        assert pilot.texts() == [f"Mode change to {mode.name} failed: requires position"]
    assert pilot.ap.mode is Mode.ALT_HOLD


def test_a_position_that_is_lost_in_flight_leaves_the_vehicle_level(pilot):
    pilot.take_off()
    pilot.hold(1.0, roll=1700)
    assert pilot.ap.set_mode(Mode.BRAKE)
    pilot.ap.position_lost = True

    pilot.hold(1.0)

    assert pilot.angles_deg()[:2] == pytest.approx([0.0, 0.0], abs=0.5)
    assert math.hypot(*pilot.ap.truth.velocity_ned_mps[:2]) > 1.0
    assert pilot.ap.set_mode(Mode.ALT_HOLD)
    assert not pilot.ap.set_mode(Mode.BRAKE)


@pytest.mark.parametrize("mode", PILOTED)
def test_without_a_position_it_is_taken_on_the_ground_but_does_not_arm(pilot, mode):
    pilot.hold(4.0, thr=1000)
    assert pilot.ap.set_mode(mode)

    assert not pilot.ap.arm(force=False)
    assert pilot.texts() == ["Arm: Need Position Estimate"]
