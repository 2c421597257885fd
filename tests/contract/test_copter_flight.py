"""Arming, sticks, releases, modes that hold, and a forced reboot as measured on ArduCopter."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import REBOOT_FORCE, is_armed, last, named
from helpers.copter_companion import (
    ACCEPTED,
    ALT_HOLD,
    BRAKE,
    FAILED,
    LOITER,
    POSHOLD,
    STABILIZE,
)

REBOOT = mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN


@pytest.mark.parametrize(
    ("mode", "sticks", "text"),
    [
        (STABILIZE, {"thr": 1300}, "Arm: Throttle too high"),
        (ALT_HOLD, {"thr": 1000, "roll": 1700}, "Arm: Roll (RC1) is not neutral"),
        (ALT_HOLD, {"thr": 1000, "pitch": 1300}, "Arm: Pitch (RC2) is not neutral"),
        (ALT_HOLD, {"thr": 1000, "yaw": 1700}, "Arm: Yaw (RC4) is not neutral"),
    ],
)
def test_arming_is_refused_with_throttle_up_and_off_neutral(armable, mode, sticks, text):
    armable.get_ready(mode)
    armable.hold(0.1, **sticks)
    assert armable.arming_refusal() == text


def test_arming_twice_is_accepted_and_a_reboot_is_refused_while_armed(armable):
    armable.get_ready(ALT_HOLD)
    assert armable.arm() == ACCEPTED
    armable.hold(0.5, thr=1000)
    assert armable.arm() == ACCEPTED
    assert armable.command(REBOOT, 1) == FAILED


@pytest.mark.parametrize(("throttle_us", "disarms"), [(1000, True), (1500, False)])
def test_an_idle_vehicle_is_disarmed_with_the_throttle_down(armable, throttle_us, disarms):
    armable.set_param("DISARM_DELAY", 1)
    armable.stream(mav.MAVLINK_MSG_ID_HEARTBEAT, 10)
    armable.get_ready(ALT_HOLD)
    assert armable.arm() == ACCEPTED
    armable.hold(0.3, thr=throttle_us)
    armed = [is_armed(m) for m in named(armable.hold(2.5, thr=throttle_us), "HEARTBEAT")]
    assert armed[0]
    assert armed[-1] != disarms


@pytest.mark.parametrize(
    ("sticks", "field", "expected_deg"),
    [
        ({"roll": 1700}, "roll", 11.26),
        ({"pitch": 1700}, "pitch", 11.27),
        ({"roll": 1300}, "roll", -11.26),
        ({"yaw": 1700}, "yawspeed", 77.8),
    ],
)
def test_sticks_lean_and_turn_as_measured(flying, sticks, field, expected_deg):
    attitudes = named(flying.hold(1.5, **sticks), "ATTITUDE")[-10:]
    mean_rad = sum(getattr(m, field) for m in attitudes) / len(attitudes)
    assert math.degrees(mean_rad) == pytest.approx(expected_deg, rel=0.04)


def test_throttle_is_a_climb_rate_in_alt_hold(flying):
    states = named(flying.hold(2.5, thr=1700), "LOCAL_POSITION_NED")[-10:]
    assert -sum(m.vz for m in states) / len(states) == pytest.approx(0.64, abs=0.05)


def test_a_forced_reboot_in_flight_leaves_it_disarmed_in_its_boot_mode(expendable):
    before_ms = last(expendable.hold(1.5), "ATTITUDE").time_boot_ms
    assert expendable.command(REBOOT, 1, 0, 0, 0, 0, REBOOT_FORCE) == ACCEPTED
    expendable.advance(1.0)
    expendable.seen.clear()
    heartbeat = expendable.wait("HEARTBEAT", timeout_s=20.0)
    assert expendable.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 20) == ACCEPTED
    after_ms = expendable.wait("ATTITUDE", timeout_s=10.0).time_boot_ms
    assert not is_armed(heartbeat)
    assert heartbeat.custom_mode == STABILIZE
    assert after_ms < before_ms


# --- after a release by the bridge

UNTOUCHED = (1500, 1500, 1000, 1500)


def position(messages):
    message = last(messages, "LOCAL_POSITION_NED")
    return message.x, message.y, message.z


def test_brake_stops_and_ignores_the_sticks(flying):
    flying.hold(1.0, roll=1754)
    assert flying.set_mode(BRAKE) == ACCEPTED
    start = position(flying.hold(3.0, thr=1000))
    end = position(flying.hold(2.0, roll=1900, pitch=1200, thr=1000, yaw=1700))
    assert math.dist(start, end) < 0.5


@pytest.mark.parametrize(("mode", "sinks"), [(ALT_HOLD, True), (LOITER, True), (BRAKE, False)])
def test_sticks_given_to_an_idle_receiver_sink_in_the_pilots_modes(flying, mode, sinks):
    assert flying.set_mode(mode) == ACCEPTED
    flying.hold(1.0)
    flying.override(*[0] * 8)
    messages = flying.advance(2.0)
    assert flying.channels()[:4] == UNTOUCHED
    assert (last(messages, "LOCAL_POSITION_NED").vz > 1.5) == sinks


@pytest.mark.parametrize("mode", [LOITER, POSHOLD])
def test_position_modes_stop_at_centred_sticks(flying, mode):
    flying.hold(1.0, pitch=1300)
    assert flying.set_mode(mode) == ACCEPTED
    start = position(flying.hold(3.7))
    end = position(flying.hold(1.5))
    assert math.dist(start, end) < 0.5
