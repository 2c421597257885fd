"""What is left when the bridge lets go: modes, receivers, failsafes as measured on ArduCopter."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

ALT_HOLD, LOITER, RTL, LAND, POSHOLD, BRAKE = 2, 5, 6, 9, 16, 17
ACCEPTED = mav.MAV_RESULT_ACCEPTED
UNTOUCHED = (1500, 1500, 1000, 1500)


def take_off(companion):
    """To some metres in ALT_HOLD, with a position."""
    for message_id in (
        mav.MAVLINK_MSG_ID_HEARTBEAT,
        mav.MAVLINK_MSG_ID_ATTITUDE,
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mav.MAVLINK_MSG_ID_RC_CHANNELS,
    ):
        companion.stream(message_id, 20)
    companion.get_ready(ALT_HOLD)
    for _ in range(60):
        if any(m.get_type() == "LOCAL_POSITION_NED" for m in companion.hold(1.0, thr=1000)):
            break
    assert companion.arm() == ACCEPTED
    companion.hold(6.0, thr=1900)
    companion.hold(2.0)


def last(messages, name):
    return [message for message in messages if message.get_type() == name][-1]


def position(messages):
    message = last(messages, "LOCAL_POSITION_NED")
    return message.x, message.y, message.z


def test_brake_stops_and_ignores_the_sticks(companion):
    take_off(companion)
    companion.hold(1.5, roll=1754)
    assert companion.set_mode(BRAKE) == ACCEPTED

    start = position(companion.hold(4.0, thr=1000))
    end = position(companion.hold(4.0, roll=1900, pitch=1200, thr=1000, yaw=1700))

    assert math.dist(start, end) < 0.5


@pytest.mark.parametrize(("mode", "sinks"), [(ALT_HOLD, True), (LOITER, True), (BRAKE, False)])
def test_sticks_given_to_an_idle_receiver_sink_in_the_pilots_modes(companion, mode, sinks):
    take_off(companion)
    assert companion.set_mode(mode) == ACCEPTED
    companion.hold(1.0)

    companion.override(*[0] * 8)
    messages = companion.advance(2.0)

    assert companion.channels()[:4] == UNTOUCHED
    assert (last(messages, "LOCAL_POSITION_NED").vz > 1.5) == sinks


@pytest.mark.parametrize("mode", [LOITER, POSHOLD])
def test_position_modes_stop_at_centred_sticks(companion, mode):
    take_off(companion)
    companion.hold(1.5, pitch=1300)
    assert companion.set_mode(mode) == ACCEPTED

    start = position(companion.hold(5.0))
    end = position(companion.hold(5.0))

    assert math.dist(start, end) < 0.5


def test_a_radio_failsafe_replaces_brake_and_one_set_after_it_stays(companion_without_receiver):
    companion = companion_without_receiver
    take_off(companion)
    assert companion.set_mode(BRAKE) == ACCEPTED
    companion.hold(0.2)

    text = companion.wait("STATUSTEXT", where=lambda m: "Failsafe" in m.text)
    heartbeat = companion.wait("HEARTBEAT")
    assert text.text == "Radio Failsafe"
    assert (heartbeat.custom_mode, heartbeat.system_status) == (RTL, mav.MAV_STATE_CRITICAL)

    assert companion.set_mode(BRAKE) == ACCEPTED
    assert last(companion.advance(5.0), "HEARTBEAT").custom_mode == BRAKE


def test_zeros_without_a_receiver_keep_the_lean_for_a_second(companion_without_receiver):
    companion = companion_without_receiver
    take_off(companion)
    companion.hold(1.0, roll=1700)

    companion.override(*[0] * 8)
    held = companion.advance(0.9)
    levelled = companion.advance(1.0)

    assert math.degrees(last(held, "ATTITUDE").roll) == pytest.approx(11.26, abs=0.3)
    assert last(levelled, "RC_CHANNELS").chan1_raw == 1700
    assert last(levelled, "HEARTBEAT").custom_mode == RTL


def test_heartbeats_are_sent_as_often_as_asked(companion):
    assert companion.stream(mav.MAVLINK_MSG_ID_HEARTBEAT, 10) == ACCEPTED
    companion.wait("HEARTBEAT")

    messages = companion.advance(2.0)

    assert sum(m.get_type() == "HEARTBEAT" for m in messages) == pytest.approx(20, abs=2)


def test_the_landed_state_follows_the_flight(companion):
    assert companion.stream(mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 10) == ACCEPTED
    assert companion.wait("EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_ON_GROUND
    take_off(companion)

    state = last(companion.hold(0.5), "EXTENDED_SYS_STATE").landed_state

    assert state == mav.MAV_LANDED_STATE_IN_AIR
