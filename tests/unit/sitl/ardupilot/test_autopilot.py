"""Flying the simulated body through every mode, and what happens when pilot or ground are lost."""

import math

import pytest

from sitl.ardupilot.flight_modes import Mode


def test_stabilize_hovers_at_mid_stick_and_climbs_above(pilot):
    pilot.take_off(mode=Mode.STABILIZE)
    pilot.hold(1.0)
    drift_mps = pilot.ap.truth.velocity_ned_mps[2]
    pilot.hold(2.0, thr=1600)

    assert abs(drift_mps) < 0.1
    assert 2.5 < -pilot.ap.truth.velocity_ned_mps[2] < 4.5


def test_acro_trainer_limits_the_lean_and_without_it_there_is_none(pilot):
    pilot.take_off(height_m=15.0, mode=Mode.ACRO)
    leans_deg = []
    pilot.hold(1.5, roll=2000, watch=lambda ap: leans_deg.append(abs(pilot.angles_deg()[0])))
    assert max(leans_deg) < 40.0

    pilot.ap.params.set("ACRO_TRAINER", 0.0)
    leans_deg.clear()
    pilot.hold(1.0, roll=2000, watch=lambda ap: leans_deg.append(abs(pilot.angles_deg()[0])))
    assert max(leans_deg) > 150.0


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


def test_a_tipped_vehicle_stops_its_motors(pilot):
    pilot.ap.params.set("ACRO_TRAINER", 0.0)
    pilot.take_off(height_m=3.0, mode=Mode.ACRO)

    pilot.hold(4.0, roll=1900, thr=1200)

    assert "Crash: Disarming" in pilot.texts()
    assert not pilot.ap.armed


def test_arming_waits_for_the_estimator(pilot):
    pilot.hold(2.0, thr=1000)
    assert not pilot.ap.arm(force=False)
    assert pilot.texts() == ["Arm: AHRS: EKF3 not started"]

    pilot.hold(1.1, thr=1000)
    assert pilot.ap.arm(force=False)


@pytest.mark.parametrize("mode", [Mode.LAND, Mode.RTL, Mode.BRAKE])
def test_automatic_modes_cannot_be_armed(pilot, mode):
    pilot.hold(6.0, thr=1000)
    pilot.ap.set_mode(mode)

    assert not pilot.ap.arm(force=False)
    assert pilot.texts() == [f"Arm: {mode.name} mode not armable"]


def test_radio_failsafe_without_position_lands(pilot_without_receiver):
    pilot = pilot_without_receiver
    pilot.hold(3.2, thr=1000)
    pilot.ap.set_mode(Mode.ALT_HOLD)
    assert pilot.ap.arm(force=False)
    pilot.hold(0.7, thr=2000)
    pilot.silence(1.05)

    assert pilot.ap.mode is Mode.LAND


@pytest.mark.parametrize(
    ("choice", "mode"), [(0, Mode.ALT_HOLD), (1, Mode.RTL), (3, Mode.LAND), (7, Mode.BRAKE)]
)
def test_fs_thr_enable_chooses_the_action(pilot_without_receiver, choice, mode):
    pilot = pilot_without_receiver
    pilot.ap.params.set("FS_THR_ENABLE", float(choice))
    pilot.take_off()

    pilot.silence(1.5)

    assert pilot.ap.mode is mode


def test_the_transmitter_switched_off_is_a_radio_failsafe(pilot):
    pilot.take_off()
    pilot.ap.rc.override([0] * 8, pilot.ap.now_ns)
    pilot.ap.rc.set_receiver([1500] * 8)
    pilot.silence(1.0)
    assert pilot.ap.mode is Mode.ALT_HOLD

    pilot.ap.rc.set_receiver([0] * 8)
    pilot.silence(1.1)
    assert pilot.ap.mode is Mode.RTL

    pilot.ap.rc.set_receiver([1500] * 8)
    pilot.silence(0.1)
    assert pilot.texts() == ["Radio Failsafe", "Radio Failsafe Cleared"]
    assert pilot.ap.mode is Mode.RTL


def test_the_mode_switch_acts_after_its_debounce_and_only_when_it_moves(pilot):
    pilot.take_off(mode=Mode.ACRO)
    pilot.ap.rc.set_receiver([1500, 1500, 1500, 1500, 1400])
    pilot.hold(0.19)
    assert pilot.ap.mode is Mode.ACRO
    pilot.hold(0.05)
    assert pilot.ap.mode is Mode.RTL

    assert pilot.ap.set_mode(Mode.ALT_HOLD)
    pilot.ap.rc.set_receiver([1500, 1500, 1500, 1500, 1450])
    pilot.hold(0.5)

    assert pilot.ap.mode is Mode.ALT_HOLD


def test_radio_failsafe_on_the_ground_disarms(pilot_without_receiver):
    pilot = pilot_without_receiver
    pilot.hold(3.5, thr=1000)
    assert pilot.ap.arm(force=False)

    pilot.silence(1.5)

    assert not pilot.ap.armed
    assert "Radio Failsafe - Disarming" in pilot.texts()


def test_a_throttle_below_fs_thr_value_is_a_radio_failsafe_after_three_reads(pilot):
    pilot.take_off()

    pilot.hold(0.01, thr=950)
    assert not pilot.ap.radio_failsafe.active
    pilot.hold(0.1, thr=950)

    assert pilot.ap.mode is Mode.RTL
    pilot.hold(0.2)
    assert pilot.texts() == ["Radio Failsafe", "Radio Failsafe Cleared"]


@pytest.mark.parametrize(("choice", "mode"), [(1, Mode.RTL), (5, Mode.LAND)])
def test_gcs_failsafe_can_end_the_flight(pilot, choice, mode):
    pilot.ap.params.set("FS_GCS_ENABLE", float(choice))
    pilot.ap.params.set("FS_OPTIONS", 0.0)
    pilot.take_off()
    pilot.ap.gcs_failsafe.on_contact(pilot.ap.now_ns)

    pilot.silence(5.5)

    assert pilot.ap.mode is mode
