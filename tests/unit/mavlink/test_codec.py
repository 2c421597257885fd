import struct
from math import hypot, inf, nan, pi, sqrt
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.flown_vehicle import codec
from helpers.wire import ARDUPILOT, WireEnd, sent
from mavbridge.core.rotation import heading_rad, quaternion_from_euler, tilt_rad
from mavbridge.core.vehicle import IDLE, NEUTRAL, Sticks, Velocity
from mavbridge.mavlink.codec.messages import (
    Altitude,
    Attitude,
    AttitudeTarget,
    AutopilotVersion,
    Body,
    CommandAck,
    Endpoint,
    EstimatorFlags,
    Heartbeat,
    LandedState,
    LocalVelocity,
    ManualControl,
    ParamAbsent,
    ParamValue,
    ParamWrite,
    RcChannels,
    SpecificForce,
    StatusText,
    SystemStatus,
    Timesync,
    VelocityTarget,
)
from mavbridge.mavlink.codec.packets import (
    CommandRefusedError,
    manual_control_of,
    pwm_of,
)

TARGET = Endpoint(1, 1)
m = dialect.MAVLink(None)


def attitude(q: tuple[float, ...], rate: tuple[float, ...], *, quaternion: bool) -> Attitude:
    return Attitude(
        is_quaternion=quaternion, boot_us=7000, ned_from_body_wxyz=q, rate_body_radps=rate
    )


R = sqrt(0.5)
CASES: list[tuple[dialect.MAVLink_message, Body]] = [
    (
        m.heartbeat_encode(2, 3, 0x81, 2, 4),
        Heartbeat(vehicle_type=2, autopilot=3, base_mode=0x81, custom_mode=2, system_status=4),
    ),
    (
        m.attitude_quaternion_encode(7, 0.5, 0.5, -0.5, 0.5, 1, 2, 3),
        attitude((0.5, 0.5, -0.5, 0.5), (1, 2, 3), quaternion=True),
    ),
    # Euler angles of one axis each, and yaw 90 after pitch 90: (R,0,0,R)*(R,0,R,0)
    (
        m.attitude_encode(7, pi / 2, 0, 0, 1, 2, 3),
        attitude((R, R, 0, 0), (1, 2, 3), quaternion=False),
    ),
    (
        m.attitude_encode(7, 0, pi / 2, 0, 0, 0, 0),
        attitude((R, 0, R, 0), (0, 0, 0), quaternion=False),
    ),
    (
        m.attitude_encode(7, 0, pi / 2, pi / 2, 0, 0, 0),
        attitude((0.5, -0.5, 0.5, 0.5), (0, 0, 0), quaternion=False),
    ),
    (
        m.local_position_ned_encode(7, 9, -8, 7, 1.5, -2.5, 0.25),
        LocalVelocity(boot_us=7000, velocity_ned_mps=(1.5, -2.5, 0.25), position_ned_m=(9, -8, 7)),
    ),
    (
        m.local_position_ned_encode(7, 9, nan, 7, 1.5, -2.5, 0.25),
        LocalVelocity(boot_us=7000, velocity_ned_mps=(1.5, -2.5, 0.25)),
    ),
    (
        m.sys_status_encode(0b111, 0b101, 0b011, 0, 0, 0, 87, *[0] * 6),
        SystemStatus(present=0b101, healthy=0b011, battery_percent=87),
    ),
    (m.extended_sys_state_encode(0, 2), LandedState(landed_state=2)),
    (m.ekf_status_report_encode(831, *[0.5] * 5), EstimatorFlags(flags=831)),
    (m.estimator_status_encode(7, 0xE5, *[0.5] * 8), EstimatorFlags(flags=0xE5)),
    (
        m.highres_imu_encode(7, 1, 2, -9.75, *[0.5] * 10, 8191),
        SpecificForce(
            message_name="HIGHRES_IMU", boot_us=7, specific_force_body_mps2=(1, 2, -9.75)
        ),
    ),
    (
        m.raw_imu_encode(7, 1000, 0, -1001, *[0] * 6),
        SpecificForce(
            message_name="RAW_IMU", boot_us=7, specific_force_body_mps2=(9.80665, 0, -9.81645665)
        ),
    ),
    (
        m.scaled_imu2_encode(7, 0, -500, 0, *[0] * 6),
        SpecificForce(
            message_name="SCALED_IMU2", boot_us=7000, specific_force_body_mps2=(0, -4.903325, 0)
        ),
    ),
    (
        m.rc_channels_encode(7, 8, *range(1001, 1009), *[0] * 10, 255),
        RcChannels(channels_us=tuple(range(1001, 1009)), boot_us=7000),
    ),
    (
        m.command_ack_encode(511, 3, 0, 0, 255, 191),
        CommandAck(command=511, result=3, target=Endpoint(255, 191)),
    ),
    (
        m.param_value_encode(b"RC1_MIN", 1100.0, 9, 100, 5),
        ParamValue(name="RC1_MIN", value=1100.0),
    ),
    (
        m.param_value_encode(b"COM_RC_IN_MODE", 3.0, 6, 100, 5),
        ParamValue(name="COM_RC_IN_MODE", value=3.0, kind=6),
    ),
    (m.param_error_encode(255, 191, b"ANGLE_MAX", -1, 1), ParamAbsent(name="ANGLE_MAX")),
    (m.statustext_encode(4, b"PreArm: no"), StatusText(text="PreArm: no")),
    (m.statustext_encode(4, b"x" * 50, 7, 1), StatusText("x" * 50, 7, 1, is_full=True)),
    (m.statustext_encode(4, b"x" * 49, 7, 2), StatusText("x" * 49, 7, 2, is_full=False)),
    (m.statustext_encode(4, b"x" * 50), StatusText("x" * 50)),
    (m.manual_control_encode(1, 122, -5, 500, 1000, 0), ManualControl(122, -5, 500, 1000)),
    (
        m.attitude_target_encode(7, 7, [0.5, 0.5, -0.5, 0.5], 1, 2, 3, 0.4),
        AttitudeTarget(7000, 7, (0.5, 0.5, -0.5, 0.5), (1, 2, 3), 0.4),
    ),
    (
        m.position_target_local_ned_encode(7, 1, 3079, nan, nan, nan, 1, 2, -3, 0, 0, 0, 0, 0.5),
        VelocityTarget(7000, 3079, (1, 2, -3), 0.5),
    ),
    (
        m.global_position_int_encode(7, 0, 0, 489423, -12345, 0, 0, 0, 0),
        Altitude(amsl_m=489.423, above_home_m=-12.345, boot_us=7000),
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
@pytest.mark.parametrize("chunking", ["whole", "byte by byte", "with a tail"])
def test_each_message_is_read_however_it_is_cut(
    message: dialect.MAVLink_message, body: Body, chunking: str
) -> None:
    data = WireEnd().pack(message)
    chunks = {
        "whole": [data],
        "byte by byte": [data[k : k + 1] for k in range(len(data))],
        "with a tail": [data + b"\xfd\x09"],
    }[chunking]
    ours = codec()
    (incoming,) = [message for chunk in chunks for message in ours.decode(chunk)]
    assert incoming.source == Endpoint(1, 1)
    assert incoming.packet == data
    assert type(incoming.body) is type(body)
    for got, wanted in zip(flat(incoming.body), flat(body), strict=True):
        assert got == (pytest.approx(wanted, abs=1e-6) if isinstance(wanted, float) else wanted)


@pytest.mark.parametrize(
    "message",
    [
        m.attitude_quaternion_encode(7, nan, 0, 0, 0, 0, 0, 0),
        m.attitude_quaternion_encode(7, 0, 0, 0, 0, 0, 0, 0),
        m.attitude_quaternion_encode(7, 1, 0, 0, 0, nan, 0, 0),
        m.attitude_encode(7, 0, float("inf"), 0, 0, 0, 0),
        m.local_position_ned_encode(7, 0, 0, 0, 0, nan, 0),
        m.highres_imu_encode(7, nan, 0, 0, *[0.5] * 10, 8191),
        m.highres_imu_encode(7, 0, 0, 0, *[0.5] * 10, 0b111000),  # says it has no accelerometer
        m.param_value_encode(b"RC1_MIN", nan, 9, 100, 5),
    ],
)
def test_unusable_values_are_counted_and_dropped(
    message: dialect.MAVLink_message,
) -> None:
    ours = codec()
    (incoming,) = ours.decode(WireEnd().pack(message))
    assert incoming.body is None
    assert ours.bad_data_count == 1


@given(
    direction=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: hypot(*q) > 0.1),
    norm=st.one_of(st.floats(0.0, 2.0), st.floats(0.89, 1.11)),
)
def test_every_attitude_that_is_taken_is_of_length_one(
    direction: tuple[float, ...], norm: float
) -> None:
    sent_q = [norm * part / hypot(*direction) for part in direction]
    (incoming,) = codec().decode(
        WireEnd().pack(m.attitude_quaternion_encode(7, *sent_q, 0.1, 0.2, 0.3))
    )
    if abs(norm - 1.0) > 0.1 + 1e-6:
        assert incoming.body is None
    elif abs(norm - 1.0) < 0.1 - 1e-6:
        taken = incoming.body.ned_from_body_wxyz
        assert hypot(*taken) == pytest.approx(1.0, abs=1e-12)
        assert [norm * part for part in taken] == pytest.approx(sent_q, abs=1e-6)


def test_a_target_that_is_none_is_no_fault() -> None:
    ours = codec()
    for message in (
        m.attitude_target_encode(7, 7, [nan] * 4, 1, 2, 3, 0.4),
        m.position_target_local_ned_encode(7, 1, 0, 1, 1, 1, nan, 2, -3, 0, 0, 0, 0, 0.5),
        m.param_error_encode(255, 191, b"COM_RC_IN_MODE", -1, 2),  # a value out of range
    ):
        (incoming,) = ours.decode(WireEnd().pack(message))
        assert incoming.body is None
    assert ours.bad_data_count == 0


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
    too_much = ParamWrite("SYS_AUTOSTART", 1e12, kind=6).as_bytes()
    assert ParamValue("SYS_AUTOSTART", too_much.value, 6).from_bytes().value == 2**31 - 1


def test_an_unused_message_is_passed_on_for_counting() -> None:
    (incoming,) = codec().decode(WireEnd().pack(m.system_time_encode(1, 2)))
    assert (incoming.name, incoming.body) == ("SYSTEM_TIME", None)


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


@given(st.binary(max_size=300))
def test_garbage_on_a_stream_costs_at_most_what_it_can_announce(garbage: bytes) -> None:
    ours, vehicle = codec(), WireEnd()
    list(ours.decode(garbage))
    # A fake header swallows the longest packet there is, twice if the first ends in another.
    seen = [message for _ in range(60) for message in ours.decode(vehicle.heartbeat())]
    assert len(seen) >= 30


def test_a_stream_that_somebody_cut_into_datagrams_is_read() -> None:
    ours, data = codec(), WireEnd().heartbeat()
    assert list(ours.decode_datagram(data[:9])) == []
    (incoming,) = ours.decode_datagram(data[9:])
    assert isinstance(incoming.body, Heartbeat)


def test_a_parameter_is_set_as_the_number_itself() -> None:
    message = sent(codec().encode_request(TARGET, ParamWrite("RC_OVERRIDE_TIME", 0.5)))
    assert message.get_type() == "PARAM_SET"
    assert (message.target_system, message.target_component) == TARGET
    assert (message.param_id, message.param_value) == ("RC_OVERRIDE_TIME", 0.5)
    assert message.param_type == dialect.MAV_PARAM_TYPE_REAL32


def test_override_holds_the_stick_channels_and_ignores_the_rest() -> None:
    pwm_us = pwm_of(Sticks(0.5, 0.25, 0.5, -0.25), ARDUPILOT)
    message = sent(codec().encode_override(TARGET, pwm_us, ARDUPILOT))
    channels = [getattr(message, f"chan{k}_raw") for k in range(1, 19)]
    assert channels == [1400, 1300, 1700, 1600, *[65535] * 4, *[0] * 10]
    assert (message.target_system, message.target_component) == (1, 1)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (255, 191)


def test_release_is_zero_on_the_stick_channels_alone() -> None:
    message = sent(codec().encode_release(TARGET, ARDUPILOT))
    channels = [getattr(message, f"chan{k}_raw") for k in range(1, 19)]
    assert channels == [0, 0, 0, 0, *[65535] * 4, *[0] * 10]


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
    assert values.sticks == sticks


@pytest.mark.parametrize(
    "values",
    [
        *((1001, 0, 500, 0), (0, -1001, 500, 0), (0, 0, 1001, 0), (0, 0, -1, 0), (0, 0, 500, 1001)),
        *((0, 0, 500, nan), (0, 0, nan, 0)),
        *((0, 0, 0, 901), (0, 0, 99, -901), (0, 0, 150, 1000)),
    ],
)
def test_what_px4_takes_for_centred_or_for_a_gesture_never_leaves(values: tuple[int, ...]) -> None:
    with pytest.raises(CommandRefusedError, match="MANUAL_CONTROL"):
        codec().encode_manual_control(1, ManualControl(*values))


@given(st.floats(-1, 1), st.floats(-1, 1))
def test_no_throttle_and_yaw_of_a_policy_are_a_gesture(throttle: float, yaw: float) -> None:
    values = manual_control_of(Sticks(throttle, yaw, 0.0, 0.0))
    assert not (values.z < 100 and abs(values.r) > 900)
    codec().encode_manual_control(1, values)
    assert values.r == round(1000 * yaw) or values.z <= 150


def test_an_attitude_is_a_quaternion_and_a_thrust() -> None:
    quaternion = quaternion_from_euler(0.2, -0.1, 3.0)
    message = sent(codec().encode_attitude(TARGET, quaternion, 0.25, now_ns=7_000_000))
    assert message.get_type() == "SET_ATTITUDE_TARGET"
    assert (message.target_system, message.target_component) == TARGET
    assert (message.type_mask, message.thrust, message.time_boot_ms) == (7, 0.25, 7)
    assert tuple(message.q) == pytest.approx(quaternion, abs=1e-7)
    assert heading_rad(tuple(message.q)) == pytest.approx(3.0, abs=1e-6)
    assert tilt_rad(quaternion) == pytest.approx(0.2232, abs=1e-3)
    codec().encode_attitude(TARGET, (1 + 0.9e-4, 0.0, 0.0, 0.0), 0.25, now_ns=0)


def test_body_rates_stand_beside_an_attitude_that_is_ignored() -> None:
    message = sent(codec().encode_rates(TARGET, (1.0, -2.0, 0.5), 0.5, now_ns=2**32 * 1_000_000))
    assert (message.type_mask, message.thrust, message.time_boot_ms) == (128, 0.5, 0)
    rates = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
    assert rates == (1.0, -2.0, 0.5)


@pytest.mark.parametrize(("is_heading_frame", "frame"), [(False, 1), (True, 8)])
def test_a_velocity_and_a_yaw_rate_alone(is_heading_frame: bool, frame: int) -> None:
    velocity = Velocity(1.5, -2.0, 0.25, 0.5)
    message = sent(
        codec().encode_velocity(TARGET, velocity, is_heading_frame=is_heading_frame, now_ns=0)
    )
    assert (message.coordinate_frame, message.type_mask) == (frame, 1479)
    assert (message.vx, message.vy, message.vz, message.yaw_rate) == velocity
    assert (message.target_system, message.target_component) == TARGET


@pytest.mark.parametrize("thrust", [nan, -0.01, 1.01, inf])
def test_a_thrust_out_of_range_never_leaves(thrust: float) -> None:
    with pytest.raises(CommandRefusedError, match="thrust"):
        codec().encode_attitude(TARGET, (1.0, 0.0, 0.0, 0.0), thrust, now_ns=0)
    with pytest.raises(CommandRefusedError, match="thrust"):
        codec().encode_rates(TARGET, (0.0, 0.0, 0.0), thrust, now_ns=0)


@pytest.mark.parametrize(
    "quaternion",
    [
        *(
            (1 + 1.1e-4, 0.0, 0.0, 0.0),
            (1 - 1.1e-4, 0.0, 0.0, 0.0),
            (0.0, 0.0, 0.0, 0.0),
            (nan, 0.0, 0.0, 0.0),
        ),
        *(quaternion_from_euler(1.5, 0.0, 0.0), quaternion_from_euler(0.0, pi, 0.0)),
    ],
)
def test_no_quaternion_that_the_autopilot_drops_or_that_turns_it_over_leaves(
    quaternion: tuple[float, float, float, float],
) -> None:
    with pytest.raises(CommandRefusedError):
        codec().encode_attitude(TARGET, quaternion, 0.5, now_ns=0)


@pytest.mark.parametrize("bad", [nan, inf, 41.0, -41.0])
@pytest.mark.parametrize("axis", range(3))
def test_no_rate_or_velocity_that_no_multirotor_has_leaves(bad: float, axis: int) -> None:
    values = [0.0] * 3
    values[axis] = bad
    with pytest.raises(CommandRefusedError):
        codec().encode_rates(TARGET, (values[0], values[1], values[2]), 0.5, now_ns=0)
    for velocity in (Velocity(*[4 * v for v in values], 0.0), Velocity(0.0, 0.0, 0.0, bad)):
        with pytest.raises(CommandRefusedError):
            codec().encode_velocity(TARGET, velocity, is_heading_frame=False, now_ns=0)


@pytest.mark.parametrize("bad", [nan, 1.0001, -1.0001, float("inf")])
@pytest.mark.parametrize("axis", range(4))
def test_a_stick_out_of_range_never_becomes_a_message(bad: float, axis: int) -> None:
    values = [0.0] * 4
    values[axis] = bad
    with pytest.raises(CommandRefusedError, match="not in"):
        pwm_of(Sticks(*values), ARDUPILOT)
    with pytest.raises(CommandRefusedError, match="not in"):
        manual_control_of(Sticks(*values))


@pytest.mark.parametrize(
    "pwm_us",
    [
        (1500, 1500, 1500, 2201),
        (1500, 799, 1500, 1500),
        (1500, 1500, 0, 1500),  # the wire's sentinels are no sticks
        (1500, 1500, 65535, 1500),
        (984, 1500, 1500, 1500),  # a throttle that is a radio failsafe
    ],
)
def test_pwm_that_no_radio_sends_never_becomes_a_message(
    pwm_us: tuple[int, int, int, int],
) -> None:
    with pytest.raises(CommandRefusedError):
        codec().encode_override(TARGET, pwm_us, ARDUPILOT)


def test_sequence_numbers_have_no_gaps() -> None:
    ours, reader = codec(), WireEnd()
    data = b"".join(ours.encode_heartbeat() for _ in range(300))
    assert [message.get_seq() for message in reader.read(data)] == [k % 256 for k in range(300)]


@pytest.mark.parametrize("kind", [None, dialect.MAV_TYPE_GCS])
def test_the_heartbeat_is_ours_without_autopilot_and_mode(kind: int | None) -> None:
    message = sent(codec().encode_heartbeat(*(() if kind is None else (kind,))))
    assert (message.get_srcSystem(), message.get_srcComponent()) == (255, 191)
    assert message.type == (kind or dialect.MAV_TYPE_ONBOARD_CONTROLLER)
    assert message.autopilot == dialect.MAV_AUTOPILOT_INVALID
    assert (message.base_mode, message.custom_mode) == (0, 0)


@pytest.mark.parametrize("length", [0, 1, 49, 50, 51, 99, 100, 101, 200])
def test_a_text_arrives_whole_in_as_many_chunks_as_it_needs(length: int) -> None:
    text = "".join(chr(97 + k % 26) for k in range(length))
    packets = codec().encode_statustext(dialect.MAV_SEVERITY_NOTICE, text)
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


def test_texts_are_bounded_ascii_and_told_apart() -> None:
    ours = codec()
    read = [
        [
            message
            for packet in ours.encode_statustext(4, text)
            for message in WireEnd().read(packet)
        ]
        for text in ("5\N{DEGREE SIGN}" + "x" * 300, "y" * 60)
    ]
    assert "".join(chunk.text for chunk in read[0]) == "5?" + "x" * 198
    assert read[0][0].id != read[1][0].id


def test_a_message_without_a_name_keeps_its_sender_and_its_place_in_the_sequence() -> None:
    """PX4 sends nine of them, 5 % of its packets, which counted as lost."""
    second = bytes([0xFD, 5, 0, 0, 7, 1, 1, 0x22, 0x01, 0x00]) + b"hello" + b"\x12\x34"
    first = bytes([0xFE, 2, 9, 3, 4, 222]) + b"hi" + b"\x12\x34"
    ours = codec()
    for packet, source, sequence in ((second, (1, 1), 7), (first, (3, 4), 9)):
        (message,) = ours.decode_datagram(packet)
        assert (message.source, message.sequence) == (source, sequence)
        assert (message.body, message.packet) == (None, packet)
