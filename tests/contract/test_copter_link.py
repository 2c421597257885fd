"""ArduCopter's side of a link as measured on the firmware: identity, streams, clock, parameters."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import named, rate_hz
from helpers.copter_companion import ACCEPTED, DENIED, UNSUPPORTED


def test_the_version_comes_on_request(companion):
    result = companion.command(
        mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 100_000
    )
    version = companion.wait("AUTOPILOT_VERSION")
    assert result == ACCEPTED
    assert version.flight_sw_version >> 16 in (4 << 8 | 7, 4 << 8 | 8)
    assert version.capabilities & mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2


@pytest.mark.parametrize(("asked_hz", "got_ms"), [(150, 6), (200, 5), (250, 4), (320, 3), (7, 142)])
def test_intervals_are_cut_to_whole_milliseconds(companion, asked_hz, got_ms):
    assert companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, asked_hz) == ACCEPTED
    companion.wait("ATTITUDE")
    attitudes = named(companion.advance(0.1 * got_ms), "ATTITUDE")
    assert rate_hz(attitudes, 0.1 * got_ms) == pytest.approx(1000.0 / got_ms, rel=0.03)


@pytest.mark.parametrize(
    "message_id",
    [
        mav.MAVLINK_MSG_ID_ATTITUDE,
        mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        mav.MAVLINK_MSG_ID_HIGHRES_IMU,
        mav.MAVLINK_MSG_ID_RC_CHANNELS,
    ],
)
def test_state_streams_at_the_requested_rate(companion, message_id):
    companion.stream(message_id, 100)
    name = mav.mavlink_map[message_id].msgname
    companion.wait(name)
    assert rate_hz(named(companion.advance(0.6), name), 0.6) == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize("asked_hz", [400, 500, 1000])
def test_rates_above_the_cap_are_denied_and_the_old_one_stays(companion, asked_hz):
    companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 50)
    assert companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, asked_hz) == DENIED
    attitudes = named(companion.advance(0.6), "ATTITUDE")
    assert rate_hz(attitudes, 0.6) == pytest.approx(50.0, rel=0.05)


@pytest.mark.parametrize(
    "message_id", [mav.MAVLINK_MSG_ID_ODOMETRY, mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED_COV, 60_000]
)
def test_unknown_messages_are_denied(companion, message_id):
    assert companion.stream(message_id, 10) == DENIED


def test_unknown_commands_are_unsupported(companion):
    assert companion.command(65_000) == UNSUPPORTED


def test_all_params_come_with_their_index(companion):
    """A UDP link may lose some of a thousand in a row: those are asked for by their index."""
    companion.send(mav.MAVLink_param_request_list_message(1, 1))
    count = companion.wait("PARAM_VALUE").param_count
    while companion.find("PARAM_VALUE", 0.5) is not None:
        pass
    seen = {m.param_index for m in named(companion.seen, "PARAM_VALUE")}
    missing = set(range(count)) - seen
    assert len(missing) <= count // 20
    for index in missing:
        companion.send(mav.MAVLink_param_request_read_message(1, 1, b"", index))
        assert companion.wait("PARAM_VALUE").param_index == index


def test_heartbeats_stream_at_the_requested_rate(companion):
    assert companion.stream(mav.MAVLINK_MSG_ID_HEARTBEAT, 10) == ACCEPTED
    companion.wait("HEARTBEAT")
    messages = companion.advance(2.0)
    assert sum(m.get_type() == "HEARTBEAT" for m in messages) == pytest.approx(20, abs=4)
