"""What the codec sends and reads at the ends of its ranges, and every field beside the command."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.flown_vehicle import codec
from helpers.wire import ARDUPILOT, WireEnd, sent
from mavbridge.core.vehicle import Sticks, Velocity
from mavbridge.mavlink.codec.calibration import PWM_LIMITS_US
from mavbridge.mavlink.codec.messages import (
    Body,
    CommandRequest,
    Endpoint,
    ManualControl,
    ParamRequest,
    RcChannels,
    StreamRequest,
)
from mavbridge.mavlink.codec.packets import (
    MOST_DATAGRAM_BYTES,
    MOST_RATE_RADPS,
    MOST_SPEED_MPS,
    CommandRefusedError,
    manual_control_of,
)

TARGET = Endpoint(1, 1)
LEVEL = (1.0, 0.0, 0.0, 0.0)
m = dialect.MAVLink(None)


def read(message: dialect.MAVLink_message) -> Body | None:
    (incoming,) = codec().decode(WireEnd().pack(message))
    return incoming.body


# --- sent


def test_an_override_may_go_to_both_ends_of_a_radio_and_down_to_the_throttle_floor() -> None:
    low_us, high_us = PWM_LIMITS_US
    floor_us = ARDUPILOT.throttle_floor_us
    message = sent(codec().encode_override(TARGET, (floor_us, low_us, high_us, 1500), ARDUPILOT))
    numbers = [channel.number for channel in ARDUPILOT.channels]
    values = [getattr(message, f"chan{number}_raw") for number in numbers]
    assert values == [floor_us, low_us, high_us, 1500]


def test_yaw_is_kept_from_the_gesture_up_to_its_bound() -> None:
    assert manual_control_of(Sticks(-0.7, 1.0, 0.0, 0.0)) == ManualControl(0, 0, 150, 800)
    assert sent(codec().encode_manual_control(1, ManualControl(0, 0, 150, 800))).buttons == 0


def test_an_attitude_has_no_rates_and_rates_have_a_level_attitude() -> None:
    ours = codec()
    attitude = sent(ours.encode_attitude(TARGET, LEVEL, 1.0, now_ns=100 * 10**9))
    rates = (attitude.body_roll_rate, attitude.body_pitch_rate, attitude.body_yaw_rate)
    assert (rates, attitude.thrust) == ((0.0, 0.0, 0.0), 1.0)
    assert attitude.time_boot_ms == 100_000
    limits = (MOST_RATE_RADPS, -MOST_RATE_RADPS, MOST_RATE_RADPS)
    assert tuple(sent(ours.encode_rates(TARGET, limits, 0.5, now_ns=0)).q) == LEVEL


def test_a_velocity_at_its_limits_is_all_that_its_message_says() -> None:
    velocity = Velocity(0.0, 0.0, -MOST_SPEED_MPS, -MOST_RATE_RADPS)
    message = sent(codec().encode_velocity(TARGET, velocity, is_heading_frame=False, now_ns=0))
    assert (message.vz, message.yaw_rate) == (-MOST_SPEED_MPS, -MOST_RATE_RADPS)
    others = ("x", "y", "z", "afx", "afy", "afz", "yaw")
    assert [getattr(message, name) for name in others] == [0.0] * 7


def test_requests() -> None:
    ours, target = codec(), (TARGET.system, TARGET.component)
    command = sent(ours.encode_request(TARGET, CommandRequest(511, (31.0, 5000.0))))
    assert (command.target_system, command.target_component) == target
    assert (command.command, command.confirmation) == (511, 0)
    params = [getattr(command, f"param{number}") for number in range(1, 8)]
    assert params == [31.0, 5000.0, *[0.0] * 5]
    param = sent(ours.encode_request(TARGET, ParamRequest("RC1_MIN")))
    assert (param.target_system, param.target_component) == target
    assert (param.param_id, param.param_index) == ("RC1_MIN", -1)
    stream = sent(ours.encode_request(TARGET, StreamRequest(10, 50)))
    assert (stream.target_system, stream.target_component) == target
    assert (stream.req_stream_id, stream.req_message_rate, stream.start_stop) == (10, 50, 1)


def test_texts_beyond_the_last_number_begin_again() -> None:
    ours = codec()
    ours._text_id = 65534
    ids = [sent(ours.encode_statustext(4, "x" * 51)[0]).id for _ in range(3)]
    assert ids == [65535, 1, 2]


# --- read


@pytest.mark.parametrize(
    ("message", "is_usable"),
    [
        (m.local_position_ned_encode(7, 0, 0, 0, 1e9, -1e9, 0), True),
        (m.local_position_ned_encode(7, 0, 0, 0, 1.1e9, 0, 0), False),
        (m.manual_control_encode(1, 0, 0, 0, 0, 0), True),
        (m.manual_control_encode(1, 1000, -1000, 1000, 1000, 0), True),
        (m.manual_control_encode(1, 0, 0, 32767, 0, 0), False),
        (m.manual_control_encode(1, 0, 0, -1, 0, 0), False),
    ],
)
def test_a_value_at_the_end_of_its_range_is_usable(
    message: dialect.MAVLink_message, is_usable: bool
) -> None:
    assert (read(message) is not None) is is_usable


@pytest.mark.parametrize(("north_m", "is_position"), [(1e9, True), (-1e9, True), (-2e9, False)])
def test_a_position_is_given_where_it_is_one(north_m: float, is_position: bool) -> None:
    body = read(m.local_position_ned_encode(7, north_m, 0, 0, 0, 0, 0))
    assert (body.position_ned_m is not None) is is_position


def test_channels_without_a_count_are_all_there() -> None:
    body = read(m.rc_channels_encode(7, 0, *range(1001, 1019), 255))
    assert body == RcChannels(tuple(range(1001, 1019)), boot_us=7000)


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


def test_bytes_that_begin_nothing_count_once() -> None:
    ours = codec()
    assert list(ours.decode_datagram(b"AT+RESET\r\n")) == []
    assert ours.bad_data_count == 1
    damaged = bytearray(WireEnd().pack(m.heartbeat_encode(2, 3, 0, 0, 4)))
    damaged[-1] ^= 1
    assert list(ours.decode(bytes(damaged))) == []
    assert ours.bad_data_count == 2


def test_without_a_beginning_a_datagram_is_no_next_piece() -> None:
    ours = codec()
    assert (
        list(ours.decode_datagram(b"x" + WireEnd().pack(m.heartbeat_encode(2, 3, 0, 0, 4)))) == []
    )
    assert ours.bad_data_count == 1


def test_a_timesync_request_has_no_answer_in_it() -> None:
    message = sent(codec().encode_timesync(-5))
    assert (message.tc1, message.ts1) == (0, -5)


def test_a_lean_up_to_the_hard_limit_leaves() -> None:
    def leaning(degrees: float) -> tuple[float, float, float, float]:
        half_rad = math.radians(degrees) / 2
        return (math.cos(half_rad), math.sin(half_rad), 0.0, 0.0)

    codec().encode_attitude(TARGET, leaning(84.9), 0.5, now_ns=0)
    with pytest.raises(CommandRefusedError, match="leans too far"):
        codec().encode_attitude(TARGET, leaning(85.1), 0.5, now_ns=0)


@pytest.mark.parametrize("us", [1, 799, 2201, 32767, 65535])
def test_a_channel_out_of_a_radios_range_is_no_reading(us: int) -> None:
    body = read(m.rc_channels_encode(7, 8, 800, 2200, us, *[1500] * 5, *[us] * 10, 255))
    assert body.channels_us == (800, 2200, 0, *[1500] * 5)
