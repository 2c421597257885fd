"""Loss of sticks, as measured on ArduCopter."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import last, named, texts_in
from helpers.copter_companion import (
    ACCEPTED,
    ACRO,
    ALT_HOLD,
    BRAKE,
    FAILED,
    LAND,
    RTL,
    STABILIZE,
)

IDLE_DESCENT_MPS = 2.5
"""An idle throttle in ALT_HOLD: PILOT_SPEED_DN, by default PILOT_SPEED_UP."""


def modes(messages):
    return [m.custom_mode for m in named(messages, "HEARTBEAT")]


def test_sticks_that_stop_are_held_until_they_expire_then_the_receivers_count(flying):
    flying.hold(1.0, roll=1700)
    held = flying.advance(2.9)
    released = flying.advance(2.6)
    assert math.degrees(last(held, "ATTITUDE").roll) == pytest.approx(11.26, abs=0.5)
    assert math.degrees(abs(last(released, "ATTITUDE").roll)) < 1.0
    assert last(released, "LOCAL_POSITION_NED").vz == pytest.approx(IDLE_DESCENT_MPS, abs=0.35)
    assert set(modes(held + released)) == {ALT_HOLD}
    assert not [text for text in texts_in(held + released) if "ailsafe" in text]


@pytest.fixture
def airborne(without_receiver):
    """In ALT_HOLD some metres up; it has sticks only while the test sends them."""
    without_receiver.fly_up()
    without_receiver.seen.clear()
    return without_receiver


def test_without_receiver_arming_needs_overrides(without_receiver):
    companion = without_receiver
    if companion.is_external:
        pytest.skip("a real vehicle has had sticks since it booted")
    companion.advance(4.0)
    companion.set_mode(ALT_HOLD)
    assert companion.arming_refusal() == "Arm: RC not found"
    companion.get_ready(ALT_HOLD)
    assert companion.arm() == ACCEPTED


def test_without_receiver_silence_is_a_radio_failsafe(airborne):
    airborne.hold(0.5, roll=1600)
    silent_ns = airborne.peer.now_ns()
    airborne.wait("STATUSTEXT", where=lambda m: m.text == "Radio Failsafe")
    fired_s = (airborne.peer.now_ns() - silent_ns) / 1e9
    assert 0.95 <= fired_s <= 1.1
    assert airborne.wait("HEARTBEAT", where=lambda m: m.custom_mode == RTL)
    assert airborne.channels()[0] == 1600
    messages = airborne.hold(1.5)
    assert "Radio Failsafe Cleared" in texts_in(messages)
    assert modes(messages)[-1] == RTL


@pytest.mark.parametrize(("gap_s", "fails"), [(0.4, False), (0.9, False), (1.2, True)])
def test_without_receiver_short_gaps_are_forgiven(airborne, gap_s, fails):
    messages = airborne.advance(gap_s - 0.02)
    assert ("Radio Failsafe" in texts_in(messages)) == fails


def test_manual_throttle_modes_are_refused_in_radio_failsafe(airborne):
    airborne.advance(2.0)
    assert airborne.set_mode(ACRO) == FAILED
    assert airborne.set_mode(STABILIZE) == FAILED
    airborne.hold(0.3)
    assert airborne.set_mode(STABILIZE) == ACCEPTED


def test_a_radio_failsafe_replaces_brake_and_one_set_after_it_stays(airborne):
    assert airborne.set_mode(BRAKE) == ACCEPTED
    airborne.hold(0.2)
    airborne.wait("STATUSTEXT", where=lambda m: m.text == "Radio Failsafe")
    heartbeat = airborne.wait("HEARTBEAT", where=lambda m: m.custom_mode == RTL)
    assert heartbeat.system_status == mav.MAV_STATE_CRITICAL
    assert airborne.set_mode(BRAKE) == ACCEPTED
    assert modes(airborne.advance(5.0))[-1] == BRAKE


def test_zeros_without_a_receiver_keep_the_lean_for_a_second(airborne):
    airborne.hold(1.0, roll=1700)
    airborne.override(*[0] * 8)
    held = airborne.advance(0.9)
    levelled = airborne.advance(1.0)
    assert math.degrees(last(held, "ATTITUDE").roll) == pytest.approx(11.26, abs=0.5)
    assert last(levelled, "RC_CHANNELS").chan1_raw == 1700
    assert modes(levelled)[-1] == RTL


def test_without_its_failsafe_the_last_stick_stays_for_good(airborne):
    airborne.set_param("FS_THR_ENABLE", 0)
    airborne.hold(1.0, roll=1700)
    messages = airborne.advance(5.0)
    assert math.degrees(last(messages, "ATTITUDE").roll) == pytest.approx(11.26, abs=0.5)
    assert modes(messages)[-1] == ALT_HOLD


def test_a_landing_by_failsafe_holds_the_height_for_four_seconds(airborne):
    airborne.set_param("FS_THR_ENABLE", 3)
    airborne.wait("HEARTBEAT", where=lambda m: m.custom_mode == LAND)
    held, sinking = (last(airborne.advance(3.0), "LOCAL_POSITION_NED").vz for _ in range(2))
    assert held == pytest.approx(0.0, abs=0.1)
    assert sinking == pytest.approx(0.5, abs=0.1)
