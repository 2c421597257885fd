"""Modes, arming and failsafes of ArduCopter on the simulated body, without a link."""

import math

import pytest

from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import VehicleConfig


def test_rtl_comes_home_and_lands(pilot):
    pilot.ap.params.set("RTL_ALT", 500.0)
    pilot.take_off(height_m=4.0)
    pilot.hold(4.0, pitch=1200)
    assert pilot.ap.truth.position_ned_m[0] > 5.0
    assert pilot.ap.set_mode(Mode.RTL)
    pilot.hold(40.0)
    north, east, _ = pilot.ap.truth.position_ned_m
    assert math.hypot(north, east) < 1.5
    assert not pilot.ap.armed


@pytest.mark.parametrize(
    ("seconds", "mode", "refusal"),
    [
        (2.0, Mode.STABILIZE, "AHRS: EKF3 not started"),
        (4.0, Mode.LOITER, "Need Position Estimate"),
        (4.0, Mode.POSHOLD, "Need Position Estimate"),
        (6.0, Mode.LAND, "LAND mode not armable"),
        (6.0, Mode.RTL, "RTL mode not armable"),
        (6.0, Mode.BRAKE, "BRAKE mode not armable"),
        (6.0, Mode.STABILIZE, None),
    ],
)
def test_arming_is_refused_with_its_reason(pilot, seconds, mode, refusal):
    pilot.hold(seconds, thr=1000)
    assert pilot.ap.set_mode(mode)
    assert pilot.ap.arm(force=False) == (refusal is None)
    assert pilot.texts() == ["Arming motors" if refusal is None else f"Arm: {refusal}"]


def test_a_lost_position_levels_the_vehicle_and_refuses_position_modes(pilot):
    pilot.take_off()
    pilot.hold(1.0, roll=1700)
    assert pilot.ap.set_mode(Mode.BRAKE)
    pilot.ap.position_lost = True
    pilot.hold(1.0)
    assert pilot.angles_deg()[:2] == pytest.approx([0.0, 0.0], abs=0.5)
    assert math.hypot(*pilot.ap.truth.velocity_ned_mps[:2]) > 1.0
    assert pilot.ap.set_mode(Mode.ALT_HOLD)
    for mode in (Mode.BRAKE, Mode.LOITER, Mode.POSHOLD, Mode.RTL, Mode.GUIDED):
        assert not pilot.ap.set_mode(mode)
        assert pilot.texts() == [f"Mode change to {mode.name} failed: requires position"]


@pytest.mark.parametrize(
    ("choice", "mode"), [(0, Mode.ALT_HOLD), (1, Mode.RTL), (3, Mode.LAND), (7, Mode.BRAKE)]
)
def test_a_parameter_selects_the_mode_of_a_failsafe(pilot, choice, mode):
    pilot = type(pilot)(VehicleConfig(receiver_us=None))
    pilot.ap.params.set("FS_THR_ENABLE", float(choice))
    pilot.take_off()
    pilot.silence(1.5)
    assert pilot.ap.mode is mode


@pytest.mark.parametrize("lifts_off", [False, True])
def test_a_radio_failsafe_on_the_ground_disarms_and_without_a_position_lands(pilot, lifts_off):
    pilot = type(pilot)(VehicleConfig(receiver_us=None))
    pilot.hold(3.2, thr=1000)
    pilot.ap.set_mode(Mode.ALT_HOLD)
    assert pilot.ap.arm(force=False)
    pilot.hold(0.7, thr=2000 if lifts_off else 1000)
    pilot.silence(1.05)
    assert pilot.ap.armed == lifts_off
    assert pilot.ap.mode is (Mode.LAND if lifts_off else Mode.ALT_HOLD)
