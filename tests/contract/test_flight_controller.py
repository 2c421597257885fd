"""Behaviour of ArduCopter that the bridge relies on, as measured on the firmware; for any peer."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

STABILIZE, ACRO, ALT_HOLD, RTL = 0, 1, 2, 6
ACCEPTED, DENIED, UNSUPPORTED, FAILED = (
    mav.MAV_RESULT_ACCEPTED,
    mav.MAV_RESULT_DENIED,
    mav.MAV_RESULT_UNSUPPORTED,
    mav.MAV_RESULT_FAILED,
)


def test_an_external_flight_controller_is_heard(external_companion):
    assert external_companion.wait("HEARTBEAT", timeout_s=30.0).get_srcComponent() == 1


def test_heartbeat_names_a_quadrotor_with_ardupilot(companion):
    heartbeat = companion.wait("HEARTBEAT")

    assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (1, 1)
    assert heartbeat.type == mav.MAV_TYPE_QUADROTOR
    assert heartbeat.autopilot == mav.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert heartbeat.get_msgbuf()[0] == 0xFD


def test_the_version_comes_on_request(companion):
    result = companion.command(
        mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_AUTOPILOT_VERSION, 100_000
    )
    version = companion.wait("AUTOPILOT_VERSION")

    assert result == ACCEPTED
    assert version.flight_sw_version >> 16 == 4 << 8 | 7
    assert version.capabilities & mav.MAV_PROTOCOL_CAPABILITY_MAVLINK2


@pytest.mark.parametrize(
    ("asked_hz", "got_us"),
    [(100, 10_000), (150, 6_000), (200, 5_000), (250, 4_000), (320, 3_000), (7, 142_000)],
)
def test_intervals_are_cut_to_whole_milliseconds(companion, asked_hz, got_us):
    assert companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, asked_hz) == ACCEPTED

    companion.send(
        mav.MAVLink_command_long_message(
            1, 1, mav.MAV_CMD_GET_MESSAGE_INTERVAL, 0, mav.MAVLINK_MSG_ID_ATTITUDE, *[0] * 6
        )
    )
    interval = companion.wait("MESSAGE_INTERVAL")

    assert (interval.message_id, interval.interval_us) == (mav.MAVLINK_MSG_ID_ATTITUDE, got_us)


@pytest.mark.parametrize(
    "message_id",
    [
        mav.MAVLINK_MSG_ID_ATTITUDE,
        mav.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        mav.MAVLINK_MSG_ID_HIGHRES_IMU,
        mav.MAVLINK_MSG_ID_RAW_IMU,
        mav.MAVLINK_MSG_ID_SCALED_IMU2,
        mav.MAVLINK_MSG_ID_RC_CHANNELS,
        mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
    ],
)
def test_state_comes_at_the_rate_asked_for_by_its_own_stamps(companion, message_id):
    companion.stream(message_id, 100)
    name = mav.mavlink_map[message_id].msgname
    companion.wait(name)

    messages = [m for m in companion.advance(1.0) if m.get_type() == name]
    stamps_s = [
        m.time_usec / 1e6 if hasattr(m, "time_usec") else m.time_boot_ms / 1e3 for m in messages
    ]

    span_s = stamps_s[-1] - stamps_s[0]
    assert (len(stamps_s) - 1) / span_s == pytest.approx(100.0, rel=0.02)


@pytest.mark.parametrize("asked_hz", [400, 500, 1000])
def test_rates_above_the_cap_are_denied_and_the_old_one_stays(companion, asked_hz):
    companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 50)

    assert companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, asked_hz) == DENIED
    messages = companion.advance(1.0)

    assert sum(m.get_type() == "ATTITUDE" for m in messages) == pytest.approx(50, abs=2)


def test_a_denied_rate_says_why(companion):
    companion.send(
        mav.MAVLink_command_long_message(
            1, 1, mav.MAV_CMD_SET_MESSAGE_INTERVAL, 0, mav.MAVLINK_MSG_ID_ATTITUDE, 1000, *[0] * 5
        )
    )

    text = companion.wait("STATUSTEXT", where=lambda m: "Requested rate" in m.text)

    assert "too fast" in text.text


@pytest.mark.parametrize(
    "message_id", [mav.MAVLINK_MSG_ID_ODOMETRY, mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED_COV, 60_000]
)
def test_unknown_messages_are_denied(companion, message_id):
    assert companion.stream(message_id, 10) == DENIED


def test_interval_with_a_third_parameter_is_denied(companion):
    command = mav.MAV_CMD_SET_MESSAGE_INTERVAL
    assert companion.command(command, mav.MAVLINK_MSG_ID_ATTITUDE, 10_000, 1.0) == DENIED


def test_interval_minus_one_stops(companion):
    companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 100)
    companion.wait("ATTITUDE")

    companion.command(mav.MAV_CMD_SET_MESSAGE_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE, -1)

    assert not [m for m in companion.advance(0.5) if m.get_type() == "ATTITUDE"]


def test_data_streams_overrule_intervals(companion):
    companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 100)

    companion.send(mav.MAVLink_request_data_stream_message(1, 1, mav.MAV_DATA_STREAM_EXTRA1, 25, 1))
    companion.wait("ATTITUDE")
    messages = companion.advance(1.0)

    assert sum(m.get_type() == "ATTITUDE" for m in messages) == pytest.approx(25, abs=2)


def test_every_command_is_acknowledged(companion):
    for number in (16, 92, 179, 300, 511, 512, 2000, 60_000):  # none that would start something
        assert companion.command(number, 0, 0, 0.5) in range(10)


def test_unknown_commands_are_unsupported(companion):
    assert companion.command(65_000) == UNSUPPORTED


def test_commands_are_taken_from_any_system(companion):
    number = mav.MAV_CMD_SET_MESSAGE_INTERVAL
    result = companion.command(number, mav.MAVLINK_MSG_ID_ATTITUDE, 10_000, system_id=42)
    assert result == ACCEPTED


def test_command_int_is_acknowledged_to_its_sender(companion):
    companion.send(
        mav.MAVLink_command_int_message(
            1, 1, 0, mav.MAV_CMD_DO_SET_MODE, 0, 0, 1, ALT_HOLD, 0, 0, 0, 0, 0
        ),
        system_id=42,
    )

    ack = companion.wait("COMMAND_ACK")

    assert (ack.result, ack.target_system, ack.target_component) == (ACCEPTED, 42, 191)


@pytest.mark.parametrize("system_id", [255, 42, 1])
def test_timesync_echoes_the_request_to_anybody(companion, system_id):
    companion.send(mav.MAVLink_timesync_message(0, 123_456_789_012), system_id=system_id)

    answer = companion.wait("TIMESYNC", where=lambda m: m.tc1 != 0)

    assert answer.ts1 == 123_456_789_012
    assert answer.tc1 > 0
    assert answer.tc1 % 1000 == 0


def test_timesync_and_telemetry_share_a_clock(companion):
    companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 100)
    companion.send(mav.MAVLink_timesync_message(0, 1))
    answer = companion.wait("TIMESYNC", where=lambda m: m.tc1 != 0)

    attitude = companion.wait("ATTITUDE")

    assert attitude.time_boot_ms - answer.tc1 / 1e6 == pytest.approx(10.0, abs=50.0)


def test_params_are_read_and_written(companion):
    assert companion.get_param("RC_OVERRIDE_TIME") == 3.0
    assert companion.set_param("RC_OVERRIDE_TIME", 0.5) == 0.5
    assert companion.get_param("RC_OVERRIDE_TIME") == 0.5


def test_all_params_come_with_their_index(companion):
    companion.send(mav.MAVLink_param_request_list_message(1, 1))
    first = companion.wait("PARAM_VALUE")
    seen = {first.param_index}
    for _ in range(60):
        seen |= {m.param_index for m in companion.advance(1.0) if m.get_type() == "PARAM_VALUE"}
        if len(seen) >= first.param_count:
            break

    assert seen >= set(range(first.param_count))


@pytest.mark.parametrize("mission_type", [0, 1, 2])
def test_there_is_no_mission(companion, mission_type):
    companion.send(mav.MAVLink_mission_request_list_message(1, 1, mission_type))

    count = companion.wait("MISSION_COUNT")

    assert (count.count, count.mission_type) == (0, mission_type)


def test_an_override_shows_in_rc_channels(companion):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)

    companion.override(1501, 1502, 1103, 1504)
    companion.advance(0.05)

    assert companion.channels()[:4] == (1501, 1502, 1103, 1504)


@pytest.mark.parametrize("value", [1, 900, 2500, 32767, 40000, 65534])
def test_overrides_have_no_range_check(companion, value):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)

    companion.override(value)
    companion.advance(0.05)

    assert companion.channels()[0] == value


@pytest.mark.parametrize(("system_id", "target"), [(42, 1), (254, 1), (1, 1), (255, 2), (255, 99)])
def test_overrides_of_others_are_ignored(companion, system_id, target):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)
    before = companion.channels()

    companion.override(1777, system_id=system_id, target=target)
    companion.advance(0.05)

    assert companion.channels() == before


def test_the_gcs_sysid_parameter_decides_at_once(companion):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)

    companion.set_param("MAV_GCS_SYSID", 42)
    companion.override(1601, system_id=42)
    companion.advance(0.05)
    companion.override(1777, system_id=255)
    companion.advance(0.05)

    assert companion.channels()[0] == 1601


def test_zero_releases_at_once_and_65535_changes_nothing(companion):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)
    companion.override(1700, 1600)
    companion.advance(0.05)

    companion.override(0, 65535)
    companion.advance(0.05)

    assert companion.channels()[:2] == (1500, 1600)


def test_aux_channels_ignore_zero_and_release_on_65534(companion):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)
    unchanged = [65535] * 8
    companion.override(*unchanged, 1700)
    companion.advance(0.05)

    companion.override(*unchanged, 0)
    companion.override(*unchanged, 65535)
    companion.advance(0.05)
    held = companion.channels()[8]
    companion.override(*unchanged, 65534)
    companion.advance(0.05)

    assert (held, companion.channels()[8]) == (1700, 0)


@pytest.mark.parametrize(("override_time_s", "low_s", "high_s"), [(3.0, 3.0, 3.1), (0.5, 0.5, 0.6)])
def test_an_override_expires(companion, override_time_s, low_s, high_s):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)
    companion.set_param("RC_OVERRIDE_TIME", override_time_s)
    sent_ns = companion.peer.now_ns()
    companion.override(1700)
    companion.wait("RC_CHANNELS", where=lambda m: m.chan1_raw == 1700)

    companion.wait("RC_CHANNELS", timeout_s=5.0, where=lambda m: m.chan1_raw == 1500)

    assert low_s <= (companion.peer.now_ns() - sent_ns) / 1e9 <= high_s


def test_ignored_fields_do_not_keep_an_override_alive(companion):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)
    companion.override(1700)
    for _ in range(160):
        companion.override()
        companion.advance(0.02)

    assert companion.channels()[0] == 1500


@pytest.mark.parametrize("override_time_s", [0.0, -1.0])
def test_override_time_zero_refuses_and_minus_one_never_expires(companion, override_time_s):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)
    companion.set_param("RC_OVERRIDE_TIME", override_time_s)

    companion.override(1700)
    companion.advance(6.0)

    assert companion.channels()[0] == (1700 if override_time_s < 0 else 1500)
    companion.override(0)


def test_manual_control_is_an_override(companion):
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 100)

    companion.send(mav.MAVLink_manual_control_message(1, 500, -500, 300, 250, 0))
    companion.advance(0.05)

    assert companion.channels()[:4] == (1250, 1250, 1300, 1625)


def test_arming_is_refused_with_throttle_up(companion):
    companion.get_ready(STABILIZE)
    companion.hold(0.1, thr=1300)

    companion.send(mav.MAVLink_command_long_message(1, 1, 400, 0, 1, *[0] * 6))
    text = companion.wait("STATUSTEXT", where=lambda m: m.text.startswith("Arm:"))

    assert text.text == "Arm: Throttle too high"


@pytest.mark.parametrize(
    ("sticks", "text"),
    [
        ({"roll": 1700}, "Arm: Roll (RC1) is not neutral"),
        ({"pitch": 1300}, "Arm: Pitch (RC2) is not neutral"),
        ({"yaw": 1700}, "Arm: Yaw (RC4) is not neutral"),
    ],
)
def test_arming_is_refused_off_neutral(companion, sticks, text):
    companion.get_ready(ALT_HOLD)
    companion.hold(0.1, thr=1000, **sticks)

    companion.send(mav.MAVLink_command_long_message(1, 1, 400, 0, 1, *[0] * 6))

    assert companion.wait("STATUSTEXT", where=lambda m: m.text.startswith("Arm:")).text == text


def test_arming_twice_is_accepted(companion):
    companion.get_ready(ALT_HOLD)

    assert companion.arm() == ACCEPTED
    companion.hold(0.5, thr=1000)
    assert companion.arm() == ACCEPTED


def test_in_flight_only_a_forced_disarm_works(companion):
    companion.get_ready(ALT_HOLD)
    companion.arm()
    companion.hold(5.0, thr=1700)

    assert companion.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0) == FAILED
    assert companion.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 0, 21196, system_id=42) == ACCEPTED


@pytest.mark.parametrize(
    ("sticks", "field", "expected_deg"),
    [
        ({"roll": 1700}, "roll", 11.26),
        ({"pitch": 1700}, "pitch", 11.27),
        ({"roll": 1300}, "roll", -11.26),
        ({"yaw": 1700}, "yawspeed", 77.8),
    ],
)
def test_sticks_lean_and_turn_as_measured(companion, sticks, field, expected_deg):
    companion.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 100)
    companion.get_ready(ALT_HOLD)
    companion.arm()
    companion.hold(6.0, thr=1700)
    companion.hold(1.0)

    messages = companion.hold(1.5, **sticks)
    attitude = [m for m in messages if m.get_type() == "ATTITUDE"][-1]

    assert math.degrees(getattr(attitude, field)) == pytest.approx(expected_deg, rel=0.04)


def test_throttle_is_a_climb_rate_in_alt_hold(companion):
    companion.stream(mav.MAVLINK_MSG_ID_VFR_HUD, 50)
    companion.get_ready(ALT_HOLD)
    companion.arm()
    companion.hold(4.0, thr=1700)

    messages = companion.hold(1.0, thr=1700)

    climb_mps = [m.climb for m in messages if m.get_type() == "VFR_HUD"][-1]
    assert climb_mps == pytest.approx(0.64, abs=0.05)


def test_without_receiver_arming_needs_overrides(companion_without_receiver):
    companion = companion_without_receiver
    companion.advance(4.0)
    companion.set_mode(ALT_HOLD)

    companion.send(mav.MAVLink_command_long_message(1, 1, 400, 0, 1, *[0] * 6))
    text = companion.wait("STATUSTEXT", where=lambda m: m.text.startswith("Arm:"))

    assert text.text == "Arm: RC not found"
    companion.get_ready(ALT_HOLD)
    assert companion.arm() == ACCEPTED


def test_without_receiver_silence_is_a_radio_failsafe(companion_without_receiver):
    companion = companion_without_receiver
    companion.stream(mav.MAVLINK_MSG_ID_RC_CHANNELS, 50)
    companion.get_ready(ALT_HOLD)
    companion.arm()
    companion.hold(5.0, thr=1700)
    companion.hold(0.2, roll=1600)
    silent_ns = companion.peer.now_ns()

    text = companion.wait("STATUSTEXT", where=lambda m: "Failsafe" in m.text)
    fired_s = (companion.peer.now_ns() - silent_ns) / 1e9

    assert text.text == "Radio Failsafe"
    assert 0.95 <= fired_s <= 1.05
    assert companion.wait("HEARTBEAT").custom_mode == RTL
    assert companion.channels()[0] == 1600

    messages = companion.hold(1.5)
    texts = [m.text for m in messages if m.get_type() == "STATUSTEXT"]
    modes = [m.custom_mode for m in messages if m.get_type() == "HEARTBEAT"]
    assert "Radio Failsafe Cleared" in texts
    assert modes[-1] == RTL


@pytest.mark.parametrize(("gap_s", "fails"), [(0.4, False), (0.95, False), (1.2, True)])
def test_without_receiver_short_gaps_are_forgiven(companion_without_receiver, gap_s, fails):
    companion = companion_without_receiver
    companion.get_ready(ALT_HOLD)
    companion.arm()
    companion.hold(5.0, thr=1700)

    messages = companion.advance(gap_s - 0.02)

    texts = [m.text for m in messages if m.get_type() == "STATUSTEXT"]
    assert ("Radio Failsafe" in texts) == fails


def test_manual_throttle_modes_are_refused_in_radio_failsafe(companion_without_receiver):
    companion = companion_without_receiver
    companion.get_ready(ALT_HOLD)
    companion.arm()
    companion.hold(5.0, thr=1700)
    companion.advance(2.0)

    assert companion.set_mode(ACRO) == FAILED
    assert companion.set_mode(STABILIZE) == FAILED
    companion.hold(0.1)
    assert companion.set_mode(STABILIZE) == ACCEPTED
