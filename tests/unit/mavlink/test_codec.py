"""What the codec sends, reads and refuses, at the ends of its ranges too."""

import math
import struct
from math import hypot, inf, nan, pi, sqrt
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.flown_vehicle import codec
from helpers.wire import ARDUPILOT, WireEnd, sent
from mavbridge.core.rotation import Quaternion, quaternion_from_euler
from mavbridge.core.vehicle import IDLE, NEUTRAL, Sticks, Velocity
from mavbridge.mavlink.codec.calibration import Pwm
from mavbridge.mavlink.codec.frames import frame_at
from mavbridge.mavlink.codec.messages import (
    Altitude,
    Attitude,
    AttitudeTarget,
    AutopilotVersion,
    Body,
    CommandAck,
    CommandRequest,
    Endpoint,
    EstimatorFlags,
    Heartbeat,
    LandedState,
    LocalVelocity,
    ManualControl,
    ParamAbsent,
    ParamRequest,
    ParamValue,
    ParamWrite,
    RcChannels,
    SpecificForce,
    StampOrder,
    StatusText,
    SystemStatus,
    Timesync,
    VelocityTarget,
)
from mavbridge.mavlink.codec.packets import (
    MOST_DATAGRAM_BYTES,
    MOST_RATE_RADPS,
    MOST_SPEED_MPS,
    CommandRefusedError,
    manual_control_of,
    pwm_of,
)

TARGET = Endpoint(1, 1)
LEVEL = (1.0, 0.0, 0.0, 0.0)
m = dialect.MAVLink(None)


def read(message: dialect.MAVLink_message) -> tuple[Any, int]:
    """Return the record of a message, and the number of bad ones."""
    ours = codec()
    (incoming,) = ours.decode(WireEnd().pack(message))
    return incoming.body, ours.bad_data_count


R = sqrt(0.5)
CASES: list[tuple[dialect.MAVLink_message, Body]] = [
    (m.heartbeat_encode(2, 3, 0x81, 2, 4), Heartbeat(2, 3, 0x81, 2, 4)),
    (
        m.attitude_quaternion_encode(7, 0.5, 0.5, -0.5, 0.5, 1, 2, 3),
        Attitude(True, 7000, (0.5, 0.5, -0.5, 0.5), (1, 2, 3)),
    ),
    # Euler angles of one axis each, and yaw 90 after pitch 90: (R,0,0,R)*(R,0,R,0)
    (m.attitude_encode(7, pi / 2, 0, 0, 1, 2, 3), Attitude(False, 7000, (R, R, 0, 0), (1, 2, 3))),
    (m.attitude_encode(7, 0, pi / 2, 0, 0, 0, 0), Attitude(False, 7000, (R, 0, R, 0), (0, 0, 0))),
    (
        m.attitude_encode(7, 0, pi / 2, pi / 2, 0, 0, 0),
        Attitude(False, 7000, (0.5, -0.5, 0.5, 0.5), (0, 0, 0)),
    ),
    (
        m.local_position_ned_encode(7, 9, -8, 7, 1.5, -2.5, 0.25),
        LocalVelocity(7000, (1.5, -2.5, 0.25), (9, -8, 7)),
    ),
    (
        m.local_position_ned_encode(7, 9, nan, 7, 1.5, -2.5, 0.25),
        LocalVelocity(7000, (1.5, -2.5, 0.25)),
    ),
    (m.sys_status_encode(0b111, 0b101, 0b011, 0, 0, 0, 87, *[0] * 6), SystemStatus(5, 3, 87)),
    (m.extended_sys_state_encode(0, 2), LandedState(landed_state=2)),
    (m.ekf_status_report_encode(831, *[0.5] * 5), EstimatorFlags(flags=831)),
    (m.estimator_status_encode(7, 0xE5, *[0.5] * 8), EstimatorFlags(flags=0xE5)),
    (
        m.highres_imu_encode(7, 1, 2, -9.75, *[0.5] * 10, 8191),
        SpecificForce("HIGHRES_IMU", 7, (1, 2, -9.75)),
    ),
    (
        m.raw_imu_encode(7, 1000, 0, -1001, *[0] * 6),
        SpecificForce("RAW_IMU", 7, (9.80665, 0, -9.81645665)),
    ),
    *(
        (kind(7, 0, -500, 0, *[0] * 6), SpecificForce(kind.msgname, 7000, (0, -4.903325, 0)))
        for kind in (dialect.MAVLink_scaled_imu_message, dialect.MAVLink_scaled_imu2_message)
    ),
    (
        m.rc_channels_encode(7, 8, *range(1001, 1009), *[0] * 10, 255),
        RcChannels(tuple(range(1001, 1009)), 7000),
    ),
    (m.command_ack_encode(511, 3, 0, 0, 255, 191), CommandAck(511, 3, Endpoint(255, 191))),
    (m.param_value_encode(b"RC1_MIN", 1100.0, 9, 100, 5), ParamValue("RC1_MIN", 1100.0)),
    (m.param_value_encode(b"COM_RC_MODE", 3.0, 6, 100, 5), ParamValue("COM_RC_MODE", 3.0, 6)),
    (m.param_error_encode(255, 191, b"ANGLE_MAX", -1, 1), ParamAbsent(name="ANGLE_MAX")),
    (m.statustext_encode(4, b"PreArm: no"), StatusText("PreArm: no")),
    (
        m.statustext_encode(4, b"\x1b[2J a\tb"),
        StatusText("\ufffd[2J a\ufffdb"),
    ),  # no terminal codes
    (m.statustext_encode(6, b"Pilot took over\t"), StatusText("Pilot took over")),
    (m.statustext_encode(6, b"Armed \t\r\n"), StatusText("Armed")),
    (m.statustext_encode(6, b"x" * 48 + b" \t", 3), StatusText("x" * 48 + " ", 3, 0, is_full=True)),
    # many bytes beyond ASCII: the last piece all the same
    (m.statustext_encode(4, "äöüÄÖÜß".encode(), 7, 1), StatusText("\ufffd" * 14, 7, 1)),
    (m.statustext_encode(4, b"x" * 50, 7, 1), StatusText("x" * 50, 7, 1, is_full=True)),
    (m.statustext_encode(4, b"x" * 49, 7, 2), StatusText("x" * 49, 7, 2, is_full=False)),
    (m.statustext_encode(4, b"x" * 50), StatusText("x" * 50)),
    (m.manual_control_encode(1, 122, -5, 500, 1000, 0), ManualControl(122, -5, 500, 1000)),
    (
        m.attitude_target_encode(7, 7, [0.5, 0.5, -0.5, 0.5], 1, 2, 3, 0.4),
        AttitudeTarget((1, 2, 3), 0.4),
    ),
    (
        m.position_target_local_ned_encode(7, 1, 3079, nan, nan, nan, 1, 2, -3, 0, 0, 0, 0, 0.5),
        VelocityTarget(3079, (1, 2, -3)),
    ),
    (
        m.global_position_int_encode(7, 0, 0, 489423, -12345, 0, 0, 0, 0),
        Altitude(amsl_m=489.423, above_home_m=-12.345, boot_us=7000),
    ),
    (
        m.rc_channels_encode(7, 0, *range(1001, 1019), 255),  # without a count: all are there
        RcChannels(tuple(range(1001, 1019)), boot_us=7000),
    ),
    (
        m.rc_channels_encode(7, 6, *range(1001, 1008), *[0] * 11, 255),  # channel 7 is overridden
        RcChannels((*range(1001, 1008), 0), boot_us=7000),
    ),
    *(
        (
            m.rc_channels_encode(7, 8, 800, 2200, us, *[1500] * 5, *[us] * 10, 255),
            RcChannels((800, 2200, 0, *[1500] * 5), boot_us=7000),
        )
        for us in (1, 799, 2201, 32767, 65535)
    ),
    *(
        (
            m.local_position_ned_encode(7, north_m, 0, 0, 0, 0, 0),
            LocalVelocity(7000, (0, 0, 0), (north_m, 0, 0) if is_position else None),
        )
        for north_m, is_position in ((1e9, True), (-1e9, True), (-2e9, False))
    ),
    (m.timesync_encode(5, -6), Timesync(tc1=5, ts1=-6)),
    (
        m.autopilot_version_encode(0, 0x04070100, 0, 0, 0, *[b"\0" * 8] * 3, 0, 0, 0),
        AutopilotVersion(version="4.7.1"),
    ),
]


def flat(body: Any) -> list[Any]:
    """Fields of a record with tuples opened, so that floats can be compared approximately."""
    out: list[Any] = []
    for value in body:
        out.extend(value if isinstance(value, tuple) else [value])
    return out


@pytest.mark.parametrize(("message", "body"), CASES, ids=lambda case: type(case).__name__)
def test_each_message_is_read(message: dialect.MAVLink_message, body: Body) -> None:
    data = WireEnd().pack(message)
    (incoming,) = codec().decode(data + b"\xfd\x09")
    assert (incoming.source, incoming.packet) == (Endpoint(1, 1), data)
    assert type(incoming.body) is type(body)
    for got, wanted in zip(flat(incoming.body), flat(body), strict=True):
        assert got == (pytest.approx(wanted, abs=1e-6) if isinstance(wanted, float) else wanted)


UNUSABLE, UNUSED = (False, 1), (False, 0)


@pytest.mark.parametrize(
    ("message", "expected"),
    [
        (m.attitude_quaternion_encode(7, nan, 0, 0, 0, 0, 0, 0), UNUSABLE),
        (m.attitude_quaternion_encode(7, 0, 0, 0, 0, 0, 0, 0), UNUSABLE),
        (m.attitude_quaternion_encode(7, 1, 0, 0, 0, nan, 0, 0), UNUSABLE),
        (m.attitude_encode(7, 0, inf, 0, 0, 0, 0), UNUSABLE),
        (m.local_position_ned_encode(7, 0, 0, 0, 0, nan, 0), UNUSABLE),
        (m.local_position_ned_encode(7, 0, 0, 0, 1e9, -1e9, 0), (True, 0)),
        (m.local_position_ned_encode(7, 0, 0, 0, 1.1e9, 0, 0), UNUSABLE),
        (m.highres_imu_encode(7, nan, 0, 0, *[0.5] * 10, 8191), UNUSABLE),
        (m.highres_imu_encode(7, 0, 0, 0, *[0.5] * 10, 0b111000), UNUSABLE),  # no accelerometer
        (m.param_value_encode(b"RC1_MIN", nan, 9, 100, 5), UNUSABLE),
        (m.manual_control_encode(1, 0, 0, 0, 0, 0), (True, 0)),
        (m.manual_control_encode(1, 1000, -1000, 1000, 1000, 0), (True, 0)),
        (m.manual_control_encode(1, 0, 0, 32767, 0, 0), UNUSABLE),
        (m.manual_control_encode(1, 0, 0, -1, 0, 0), UNUSABLE),
        (m.manual_control_encode(1, 1001, 0, 0, 0, 0), UNUSABLE),
        (m.manual_control_encode(1, 0, -1001, 0, 0, 0), UNUSABLE),
        (m.manual_control_encode(1, 0, 0, 0, 32767, 0), UNUSABLE),
        # no target, a value out of range, an unused message: no fault
        (m.attitude_target_encode(7, 7, [nan] * 4, 1, 2, 3, 0.4), UNUSED),
        (m.position_target_local_ned_encode(7, 1, 0, 1, 1, 1, nan, 2, -3, *[0] * 5), UNUSED),
        (m.param_error_encode(255, 191, b"COM_RC_IN_MODE", -1, 2), UNUSED),
        (m.system_time_encode(1, 2), UNUSED),
    ],
)
def test_unusable_values_are_counted_and_dropped(
    message: dialect.MAVLink_message, expected: tuple[bool, int]
) -> None:
    body, bad = read(message)
    assert (body is not None, bad) == expected


@given(
    direction=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: hypot(*q) > 0.1),
    norm=st.one_of(st.floats(0.0, 2.0), st.floats(0.89, 1.11)),
)
def test_every_attitude_that_is_taken_is_of_length_one(
    direction: tuple[float, ...], norm: float
) -> None:
    sent_q = [norm * part / hypot(*direction) for part in direction]
    body, _ = read(m.attitude_quaternion_encode(7, *sent_q, 0.1, 0.2, 0.3))
    if abs(norm - 1.0) > 0.1 + 1e-6:
        assert body is None
    elif abs(norm - 1.0) < 0.1 - 1e-6:
        taken = body.ned_from_body_wxyz
        assert hypot(*taken) == pytest.approx(1.0, abs=1e-12)
        assert [norm * part for part in taken] == pytest.approx(sent_q, abs=1e-6)


@given(st.binary(max_size=300), st.integers(0, 20))
def test_garbage_and_cut_off_datagrams_cost_nothing_that_comes_after(
    garbage: bytes, cut: int
) -> None:
    ours, vehicle = codec(), WireEnd()
    list(ours.decode_datagram(garbage))
    list(ours.decode_datagram(vehicle.heartbeat()[: -cut or None]))
    list(ours.decode_datagram(vehicle.heartbeat() + vehicle.heartbeat()[: -cut or None]))
    (incoming,) = list(ours.decode_datagram(vehicle.heartbeat()))[-1:]
    assert isinstance(incoming.body, Heartbeat)


@pytest.mark.parametrize("size", [16, 64, 512])
def test_a_stream_that_somebody_cut_into_datagrams_is_read(size: int) -> None:
    """Chunks may begin with a byte of a packet that looks like a marker."""
    ours, end, station = codec(), WireEnd(), WireEnd(system=255)
    sent = [end.pack(m.heartbeat_encode(2, 3, 81, 0xFDFEFDFE, 4)) for _ in range(200)]
    read, data = [], b"".join(sent)[15:]  # its beginning was lost
    for at in range(0, len(data), size):
        read += list(ours.decode_datagram(data[at : at + size], ("vehicle", 1)))
        assert len(list(ours.decode_datagram(station.heartbeat(), ("station", 1)))) == 1
    assert [message.packet for message in read] == sent[1:]


def test_a_packet_is_not_completed_by_another_sender() -> None:
    ours, data = codec(), WireEnd().heartbeat()
    assert list(ours.decode_datagram(data[:9], ("stranger", 1))) == []
    assert list(ours.decode_datagram(data[9:], ("vehicle", 1))) == []
    (incoming,) = ours.decode_datagram(data[9:], ("stranger", 1))
    assert isinstance(incoming.body, Heartbeat)
    assert list(ours.decode_datagram(data[:9])) == []
    ours.forget_partials()
    assert list(ours.decode_datagram(data[9:])) == []


def test_unfinished_packets_of_the_newest_16_senders_are_kept() -> None:
    ours, data = codec(), WireEnd().heartbeat()
    for sender in range(17):
        assert list(ours.decode_datagram(data[:9], ("sender", sender))) == []
    read = [len(list(ours.decode_datagram(data[9:], ("sender", each)))) for each in range(17)]
    assert read == [0, *[1] * 16]


def test_a_datagram_is_read_to_its_limit_and_what_is_lost_counts_once() -> None:
    heartbeat = WireEnd().pack(m.heartbeat_encode(2, 3, 0, 0, 4))
    whole = heartbeat * (MOST_DATAGRAM_BYTES // len(heartbeat))
    assert MOST_DATAGRAM_BYTES == 4096
    padded = whole + bytes(MOST_DATAGRAM_BYTES - len(whole))
    counts = []
    for data in (padded, padded + b"\0", padded + heartbeat):
        ours = codec()
        assert len(list(ours.decode_datagram(data))) == len(whole) // len(heartbeat)
        counts.append(ours.bad_data_count)
    assert counts == [counts[0], counts[0] + 1, counts[0] + 1]


def test_a_message_without_a_name_keeps_its_sender_and_its_place_in_the_sequence() -> None:
    """PX4 sends nine of them, 5 % of its packets, which counted as lost."""
    second = bytes([0xFD, 5, 0, 0, 7, 1, 1, 0, 0, 1]) + b"hello" + b"\x12\x34"
    first = bytes([0xFE, 2, 9, 3, 4, 222]) + b"hi" + b"\x12\x34"
    assert (frame := frame_at(second, 0)) is not None
    assert frame.message_id == 65536
    ours = codec()
    for packet, source, sequence in ((second, (1, 1), 7), (first, (3, 4), 9)):
        (message,) = ours.decode_datagram(packet)
        assert (message.source, message.sequence) == (source, sequence)
        assert (message.body, message.packet) == (None, packet)
        assert message.name == "UNKNOWN"


@pytest.mark.parametrize(
    ("stamps_ms", "accepted"),
    [
        ((5000, 4990, 5000, 5010), (True, False, False, True)),
        ((5000, 3000, 5010, 3010), (True, False, True, False)),
        ((5000, 4000, 4000, 4000), (True, False, False, False)),  # late by no more than a second
        ((5000, 3999.999, 3999.999), (True, False, True)),  # the clock has restarted
        ((5000, 10, 4990, 20), (True, False, False, False)),
        ((2**32 - 10, 4, 2**32 - 5, 14), (True, True, False, True)),
        ((2**32 - 999, 1), (True, True)),  # a second across the wrap is a wrap
        ((0, 0, 5000, 0), (True, True, True, True)),  # unstamped
        ((0.001, 0.001, 0.002), (True, False, True)),
    ],
)
def test_late_and_doubled_stamps_are_left_out_until_two_in_a_row_are_far_back(
    stamps_ms: tuple[float, ...], accepted: tuple[bool, ...]
) -> None:
    order = StampOrder()
    assert tuple(order.accepts(round(1000 * at_ms)) for at_ms in stamps_ms) == accepted


def test_a_text_is_whole_unless_it_says_something_else() -> None:
    assert StatusText("whole") == ("whole", 0, 0, False)


# --- sent


def test_requests() -> None:
    ours = codec()

    def request(what: Any) -> Any:
        message = sent(ours.encode_request(TARGET, what))
        assert (message.target_system, message.target_component) == TARGET
        return message

    command = request(CommandRequest(511, (31.0, 5000.0)))
    assert (command.command, command.confirmation) == (511, 0)
    params = [getattr(command, f"param{number}") for number in range(1, 8)]
    assert params == [31.0, 5000.0, *[0.0] * 5]
    param = request(ParamRequest("RC1_MIN"))
    assert (param.param_id, param.param_index) == ("RC1_MIN", -1)
    written = request(ParamWrite("RC_OVERRIDE_TIME", 0.5))
    assert (written.get_type(), written.param_id) == ("PARAM_SET", "RC_OVERRIDE_TIME")
    assert (written.param_value, written.param_type) == (0.5, dialect.MAV_PARAM_TYPE_REAL32)
    timesync = sent(ours.encode_timesync(-5))
    assert (timesync.tc1, timesync.ts1) == (0, -5)  # no answer in it


@pytest.mark.parametrize(
    ("pwm_us", "channels_us"),
    [
        (pwm_of(Sticks(0.5, 0.25, 0.5, -0.25), ARDUPILOT), [1400, 1300, 1700, 1600]),
        ((ARDUPILOT.throttle_floor_us, 800, 2200, 1500), [1500, 2200, 985, 800]),
        (None, [0, 0, 0, 0]),
    ],
    ids=["sticks", "both ends of a radio, and the throttle's floor", "release"],
)
def test_overrides_and_releases_hold_the_stick_channels_alone(
    pwm_us: Pwm | None, channels_us: list[int]
) -> None:
    ours = codec()
    message = sent(ours.encode_override(TARGET, pwm_us, ARDUPILOT))
    channels = [getattr(message, f"chan{k}_raw") for k in range(1, 19)]
    assert channels == [*channels_us, *[65535] * 4, *[0] * 10]
    assert (message.target_system, message.target_component) == TARGET
    assert (message.get_srcSystem(), message.get_srcComponent()) == (255, 191)


@pytest.mark.parametrize(
    ("sticks", "xyzr"),
    [
        (NEUTRAL, (0, 0, 500, 0)),
        (IDLE, (0, 0, 0, 0)),
        (Sticks(1, 0.25, 0.5, -1), (500, -1000, 1000, 250)),
    ],
)
def test_manual_control(sticks: Sticks, xyzr: tuple[int, ...]) -> None:
    values = manual_control_of(sticks)
    message = sent(codec().encode_manual_control(1, values))
    assert (message.x, message.y, message.z, message.r) == xyzr
    assert (message.buttons, values.sticks) == (0, sticks)


@given(st.floats(-1, 1), st.floats(-1, 1))
def test_no_throttle_and_yaw_of_a_policy_are_a_gesture(throttle: float, yaw: float) -> None:
    values = manual_control_of(Sticks(throttle, yaw, 0.0, 0.0))
    assert not (values.z < 100 and abs(values.r) > 900)
    codec().encode_manual_control(1, values)
    assert values.r == round(1000 * yaw) or values.z <= 150
    assert manual_control_of(Sticks(-0.7, 1.0, 0.0, 0.0)) == ManualControl(0, 0, 150, 800)


def test_an_attitude_has_a_thrust_and_no_rates() -> None:
    quaternion = quaternion_from_euler(0.2, -0.1, 3.0)
    message = sent(codec().encode_attitude(TARGET, quaternion, NO_RATES, 0.25, now_ns=100 * 10**9))
    assert (message.get_type(), message.type_mask) == ("SET_ATTITUDE_TARGET", 7)
    assert (message.target_system, message.target_component) == TARGET
    assert (message.thrust, message.time_boot_ms) == (0.25, 100_000)
    assert tuple(message.q) == pytest.approx(quaternion, abs=1e-7)
    rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
    assert rates == (0.0, 0.0, 0.0)
    codec().encode_attitude(TARGET, (1 + 0.9e-4, 0.0, 0.0, 0.0), NO_RATES, 1.0, now_ns=0)
    codec().encode_attitude(TARGET, leaning(84.9), NO_RATES, 0.0, now_ns=0)


def leaning(degrees: float) -> Quaternion:
    half_rad = math.radians(degrees) / 2
    return (math.cos(half_rad), math.sin(half_rad), 0.0, 0.0)


@pytest.mark.parametrize(
    "rates", [(1.0, -2.0, 0.5), (MOST_RATE_RADPS, -MOST_RATE_RADPS, MOST_RATE_RADPS)]
)
def test_body_rates_stand_beside_a_level_attitude_that_is_ignored(
    rates: tuple[float, float, float],
) -> None:
    message = sent(codec().encode_attitude(TARGET, None, rates, 0.5, now_ns=2**32 * 1_000_000))
    assert (message.type_mask, message.thrust, message.time_boot_ms) == (128, 0.5, 0)
    assert (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate) == rates
    assert tuple(message.q) == LEVEL


@pytest.mark.parametrize(("is_heading_frame", "frame"), [(False, 1), (True, 8)])
@pytest.mark.parametrize(
    "velocity",
    [Velocity(1.5, -2.0, 0.25, 0.5), Velocity(0.0, 0.0, -MOST_SPEED_MPS, -MOST_RATE_RADPS)],
)
def test_a_velocity_and_a_yaw_rate_alone(
    velocity: Velocity, is_heading_frame: bool, frame: int
) -> None:
    message = sent(
        codec().encode_velocity(TARGET, velocity, is_heading_frame=is_heading_frame, now_ns=0)
    )
    assert (message.coordinate_frame, message.type_mask) == (frame, 1479)
    assert (message.vx, message.vy, message.vz, message.yaw_rate) == velocity
    others = ("x", "y", "z", "afx", "afy", "afz", "yaw")
    assert [getattr(message, name) for name in others] == [0.0] * 7
    assert (message.target_system, message.target_component) == TARGET


NO_RATES = (0.0, 0.0, 0.0)
ODD_QUATERNIONS = (
    *((1 + 1.1e-4, 0.0, 0.0, 0.0), (1 - 1.1e-4, 0.0, 0.0, 0.0)),
    *((0.0, 0.0, 0.0, 0.0), (nan, 0.0, 0.0, 0.0), leaning(85.1)),
    *(quaternion_from_euler(1.5, 0.0, 0.0), quaternion_from_euler(0.0, pi, 0.0)),
)
# Of PX4: out of range, which it takes for centred, and the gestures that arm and disarm.
ODD_STICKS = (
    *((1001, 0, 500, 0), (0, -1001, 500, 0), (0, 0, 1001, 0), (0, 0, -1, 0), (0, 0, 500, 1001)),
    *((0, 0, 500, nan), (0, 0, nan, 0), (0, 0, 0, 901), (0, 0, 99, -901), (0, 0, 150, 1000)),
)
ODD_PWM = (
    *((1500, 1500, 1500, 2201), (1500, 799, 1500, 1500)),
    *((1500, 1500, 0, 1500), (1500, 1500, 65535, 1500)),  # the wire's sentinels are no sticks
    (984, 1500, 1500, 1500),  # a throttle that is a radio failsafe
)


@pytest.mark.parametrize(
    ("encode", "message"),
    [
        *(
            (
                lambda c, q=q: c.encode_attitude(TARGET, q, NO_RATES, 0.5, now_ns=0),
                "quaternion|leans too far",
            )
            for q in ODD_QUATERNIONS
        ),
        *((lambda c, v=v: c.encode_manual_control(1, ManualControl(*v)), "MANUAL_CONTROL")
          for v in ODD_STICKS),
        *((lambda c, v=v: c.encode_override(TARGET, v, ARDUPILOT), "us ") for v in ODD_PWM),
        *(
            (lambda c, v=thrust: c.encode_attitude(TARGET, LEVEL, NO_RATES, v, now_ns=0), "thrust")
            for thrust in (nan, -0.01, 1.01, inf)
        ),
    ],
)  # fmt: skip
def test_what_no_vehicle_should_get_never_leaves(encode: Any, message: str) -> None:
    with pytest.raises(CommandRefusedError, match=message):
        encode(codec())


@pytest.mark.parametrize("bad", [nan, inf, 41.0, -41.0])
@pytest.mark.parametrize("axis", range(3))
def test_no_rate_or_velocity_that_no_multirotor_has_leaves(bad: float, axis: int) -> None:
    values = [0.0] * 3
    values[axis] = bad
    with pytest.raises(CommandRefusedError, match="body rates"):
        codec().encode_attitude(TARGET, None, (values[0], values[1], values[2]), 0.5, now_ns=0)
    for velocity in (Velocity(*[4 * v for v in values], 0.0), Velocity(0.0, 0.0, 0.0, bad)):
        with pytest.raises(CommandRefusedError, match="velocity"):
            codec().encode_velocity(TARGET, velocity, is_heading_frame=False, now_ns=0)


@pytest.mark.parametrize("bad", [nan, 1.0001, -1.0001, inf])
@pytest.mark.parametrize("axis", range(4))
def test_a_stick_out_of_range_never_becomes_a_message(bad: float, axis: int) -> None:
    sticks = Sticks(*(bad if k == axis else 0.0 for k in range(4)))
    with pytest.raises(CommandRefusedError, match="not in"):
        pwm_of(sticks, ARDUPILOT)
    with pytest.raises(CommandRefusedError, match="not in"):
        manual_control_of(sticks)
    assert pwm_of(Sticks(1, -1, 1, -1), ARDUPILOT) == (1900, 1100, 1100, 1100)


@pytest.mark.parametrize("number", [0, 1, -1, 10040, 2**31 - 1, -(2**31)])
def test_an_integer_parameter_of_px4_stands_in_the_bytes_of_the_float(number: int) -> None:
    written = ParamWrite("SYS_AUTOSTART", float(number), kind=6).as_bytes()
    message = sent(codec().encode_request(TARGET, written))
    assert message.param_type == 6
    assert struct.pack("<f", message.param_value) == struct.pack("<i", number)
    answer = m.param_value_encode(b"SYS_AUTOSTART", message.param_value, 6, 100, 5)
    (incoming,) = codec().decode(WireEnd().pack(answer))
    assert incoming.body.from_bytes().value == number


def test_a_parameter_that_is_no_integer_is_written_as_it_is() -> None:
    real = ParamWrite("COM_RC_LOSS_T", 0.5)
    assert real.as_bytes() == real
    assert ParamValue("COM_RC_LOSS_T", 0.5, 9).from_bytes().value == 0.5
    for too_much, nearest in ((1e12, 2**31 - 1), (-1e12, -(2**31))):
        written = ParamWrite("SYS_AUTOSTART", too_much, kind=6).as_bytes()
        assert ParamValue("SYS_AUTOSTART", written.value, 6).from_bytes().value == nearest


def test_packets_are_numbered_in_one_byte() -> None:
    ours = codec()
    assert [ours.encode_heartbeat()[4] for _ in range(257)] == [*range(256), 0]


@pytest.mark.parametrize("kind", [None, dialect.MAV_TYPE_GCS])
def test_packets_are_pymavlinks_to_the_last_byte(kind: int | None) -> None:
    theirs = dialect.MAVLink(None, srcSystem=255, srcComponent=191)
    wanted = theirs.heartbeat_encode(kind or 18, dialect.MAV_AUTOPILOT_INVALID, 0, 0, 4)
    assert codec().encode_heartbeat(*(() if kind is None else (kind,))) == wanted.pack(theirs)
    nothing = theirs.timesync_encode(0, 0)
    assert codec().encode_timesync(0) == nothing.pack(theirs)


@pytest.mark.parametrize("length", [0, 1, 49, 50, 51, 99, 100, 101, 200])
def test_a_text_arrives_whole_in_as_many_chunks_as_it_needs(length: int) -> None:
    text = "".join(chr(97 + k % 26) for k in range(length))
    packets = codec().encode_statustext(text)
    chunks = [message for packet in packets for message in WireEnd().read(packet)]
    assert "".join(chunk.text for chunk in chunks) == text
    assert [chunk.chunk_seq for chunk in chunks] == list(range(len(chunks)))
    assert {chunk.severity for chunk in chunks} == {5}
    if length <= 50:
        assert [chunk.id for chunk in chunks] == [0]
    else:
        assert {chunk.id for chunk in chunks} == {1}
        assert all(len(chunk.text) == 50 for chunk in chunks[:-1])
        assert len(chunks[-1].text) < 50  # a zero byte tells that it is the last


def test_texts_are_bounded_ascii_and_numbered() -> None:
    ours = codec()
    packets = ours.encode_statustext("5\N{DEGREE SIGN}" + "x" * 300)
    assert "".join(sent(packet).text for packet in packets) == "5?" + "x" * 198
    ours._text_id = 65534
    ids = [sent(ours.encode_statustext("x" * 51)[0]).id for _ in range(3)]
    assert ids == [65535, 1, 2]  # beyond the last number they begin again
