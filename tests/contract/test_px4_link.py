"""PX4's side of a link as measured on the firmware: identity, streams, parameters, clock, texts."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import rate_hz
from helpers.px4_companion import (
    ACCEPTED,
    ALTCTL,
    CURRENT_MODE,
    EVENT,
    LOITER,
    POSCTL,
    REJECTED,
    Px4Companion,
    custom,
    event_id,
    modes_in,
    named,
)

ARMED_BY = 0x0190CAF3
FAILED, UNSUPPORTED = mav.MAV_RESULT_FAILED, mav.MAV_RESULT_UNSUPPORTED
SET_INTERVAL = mav.MAV_CMD_SET_MESSAGE_INTERVAL


def test_heartbeats_stay_at_one_hertz(px4):
    assert px4.command(SET_INTERVAL, mav.MAVLINK_MSG_ID_HEARTBEAT, 100_000) == FAILED

    def change_modes(elapsed_s: float) -> None:
        mode = ALTCTL if int(elapsed_s * 5.0) % 2 else LOITER
        px4.send_command(mav.MAV_CMD_DO_SET_MODE, 1, *mode)

    messages = px4.repeat(change_modes, 3.0, hz=5)
    assert len(named(messages, "HEARTBEAT")) == pytest.approx(3, abs=1)


def test_current_mode_comes_at_a_change_and_twice_a_second(px4):
    px4.set_mode(LOITER)
    assert px4.stream(CURRENT_MODE, 50) == ACCEPTED
    px4.advance(1.0)
    quiet = modes_in(px4.advance(3.0))
    px4.seen.clear()
    px4.set_mode(ALTCTL)
    px4.advance(0.15)
    assert 5 <= len(quiet) <= 8
    assert custom(ALTCTL) in [m.custom_mode for m in modes_in(px4.seen)]
    assert modes_in(px4.advance(1.0))[-1].intended_custom_mode == custom(ALTCTL)


def test_the_version_comes_on_request(px4):
    version = px4.request(mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION, "AUTOPILOT_VERSION")
    assert version.flight_sw_version >> 16 == 1 << 8 | 18
    assert version.capabilities & mav.MAV_PROTOCOL_CAPABILITY_SET_ATTITUDE_TARGET
    assert px4.command(mav.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES, 1) == UNSUPPORTED


@pytest.mark.parametrize(
    ("message_id", "asked_hz", "low_hz", "high_hz"),
    [
        (mav.MAVLINK_MSG_ID_ATTITUDE, 50, 49, 51),
        (mav.MAVLINK_MSG_ID_ATTITUDE, 100, 98, 102),
        (mav.MAVLINK_MSG_ID_ATTITUDE, 125, 120, 127),
        (mav.MAVLINK_MSG_ID_ATTITUDE, 200, 115, 130),
        (mav.MAVLINK_MSG_ID_HIGHRES_IMU, 250, 200, 251),
        (mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 50, 44, 56),  # by arrival: it has no stamp
    ],
)
def test_state_streams_at_the_requested_rate_up_to_that_of_its_topic(
    px4, message_id, asked_hz, low_hz, high_hz
):
    assert px4.stream(message_id, asked_hz) == ACCEPTED
    px4.advance(0.3)
    name = mav.mavlink_map[message_id].msgname
    messages = named(px4.repeat(lambda _: None, 2.0), name)
    assert low_hz <= rate_hz(messages, 2.0) <= high_hz


@pytest.mark.parametrize("message_id", [0, 27, 35, 60_000])
def test_a_message_that_cannot_be_streamed_fails(px4, message_id):
    assert px4.stream(message_id, 10) == FAILED


def test_an_integer_travels_as_its_bytes(px4):
    assert px4.get_int("COM_RC_IN_MODE") == 1
    px4.change("COM_RC_IN_MODE", 3)
    assert px4.get_int("COM_RC_IN_MODE") == 3


def test_local_position_streams_and_the_estimator_reports_its_validity(px4):
    px4.stream(mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 50)
    px4.stream(mav.MAVLINK_MSG_ID_ESTIMATOR_STATUS, 5)
    px4.get_ready(POSCTL)
    messages = px4.advance(1.0)
    assert named(messages, "LOCAL_POSITION_NED")
    horizontal = mav.ESTIMATOR_POS_HORIZ_REL | mav.ESTIMATOR_VELOCITY_HORIZ
    flags = named(messages, "ESTIMATOR_STATUS")[-1].flags
    assert flags & horizontal == horizontal


def test_arming_is_an_event_and_to_a_ground_station_a_text(px4_armable):
    px4_armable.get_ready(ALTCTL)
    px4_armable.seen.clear()
    assert px4_armable.arm() == ACCEPTED
    assert px4_armable.hears("Armed by external command")
    px4_armable.fly(0.5)
    events = named(px4_armable.seen, f"UNKNOWN_{EVENT}")
    assert ARMED_BY in [event_id(m) for m in events]


def test_refused_modes_say_so(px4):
    assert px4.command(mav.MAV_CMD_DO_SET_MODE, 1, 9, 0) == REJECTED
    assert px4.command(mav.MAV_CMD_DO_SET_MODE, 1, 4, 99) == REJECTED
    assert px4.command(mav.MAV_CMD_DO_SET_MODE, 0, *ALTCTL) == REJECTED


def test_texts_need_a_ground_station(px4_armable):
    # A link that had a heartbeat keeps its ground station: only a fresh one can show this.
    if px4_armable.is_external:
        pytest.skip("an external vehicle has heard ground stations already")
    silent = Px4Companion(px4_armable.peer, is_gcs=False)
    silent.may_arm = True
    px4_armable.peer.vehicle.reboot()
    silent.advance(6.0)
    silent.set_mode(ALTCTL)
    silent.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    messages = silent.advance(0.5)
    assert not named(messages, "STATUSTEXT")
    assert named(silent.seen, f"UNKNOWN_{EVENT}")
