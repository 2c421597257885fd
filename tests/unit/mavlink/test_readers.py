"""The fast path must give exactly what pymavlink's parser and packer give."""

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.messages import (
    Body,
    CurrentMode,
    Endpoint,
    Event,
    ReceivedMessage,
)
from mavbridge.mavlink.codec.packets import Codec, pack_override
from mavbridge.mavlink.codec.readers import MISSING_IDS, READERS, decode_packet

byte = st.integers(0, 255)
pwm = st.integers(0, 65535)
number = st.floats(width=32)


@given(st.lists(pwm, min_size=8, max_size=8), byte, st.tuples(byte, byte), st.tuples(byte, byte))
def test_an_override_is_packed_as_pymavlink_packs_it(
    channels_us: list[int], sequence: int, source: tuple[int, int], target: tuple[int, int]
) -> None:
    mav = dialect.MAVLink(None, srcSystem=source[0], srcComponent=source[1])
    mav.seq = sequence
    expected = mav.rc_channels_override_encode(*target, *channels_us).pack(mav)
    assert pack_override(Endpoint(*source), sequence, Endpoint(*target), channels_us) == expected


@st.composite
def state_packets(draw: st.DrawFn) -> bytes:
    """Any values, zeros at the end among them, which MAVLink 2 cuts off; signed, old."""
    mav = dialect.MAVLink(None, srcSystem=draw(byte), srcComponent=draw(byte))
    mav.seq = draw(byte)
    numbers = [draw(number | st.just(0.0)) for _ in range(13)]
    message = draw(
        st.sampled_from(
            (
                mav.attitude_quaternion_encode(7, *numbers[:7]),
                mav.attitude_quaternion_encode(7, 0.5, 0.5, -0.5, 0.5, 1.0, 2.0, 3.0),
                mav.local_position_ned_encode(7, *numbers[:6]),
                mav.highres_imu_encode(7, *numbers, draw(st.integers(0, 65535))),
                mav.attitude_encode(7, *numbers[:6]),
            )
        )
    )
    if draw(st.booleans()):
        mav.signing.secret_key = bytes(32)
        mav.signing.sign_outgoing = True
    packed: bytes = message.pack(mav, force_mavlink1=draw(st.booleans()))
    return packed


def by_pymavlink(data: bytes) -> list[ReceivedMessage]:
    """Byte by byte, which the fast path does not take."""
    codec = Codec(source_system=255, source_component=191)
    return [message for k in range(len(data)) for message in codec.decode(data[k : k + 1])]


@given(state_packets())
def test_a_packet_is_decoded_as_pymavlink_decodes_it(data: bytes) -> None:
    decoded = decode_packet(data)
    expected = by_pymavlink(data)
    if decoded is not None:
        assert [decoded] == expected
    codec = Codec(source_system=255, source_component=191)
    assert list(codec.decode_datagram(data)) == expected


@given(state_packets(), st.data())
def test_a_damaged_packet_is_left_to_pymavlink(data: bytes, draws: st.DataObject) -> None:
    k = draws.draw(st.integers(0, len(data) - 1))
    damaged = bytes((*data[:k], data[k] ^ draws.draw(st.integers(1, 255)), *data[k + 1 :]))
    decoded = decode_packet(damaged)
    assert decoded is None or [decoded] == by_pymavlink(damaged)
    assert decode_packet(data[:k]) is None


@st.composite
def any_packets(draw: st.DrawFn) -> bytes:
    """A sound packet of any message, with any payload, cut off as MAVLink 2 does."""
    names = st.sampled_from(sorted(READERS)) | st.sampled_from(["VFR_HUD", "GPS_RAW_INT", "PING"])
    name = draw(names.filter(lambda name: name not in MISSING_IDS))
    number = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
    message = dialect.mavlink_map[number]
    size = message.unpacker.size
    payload = draw(st.binary(min_size=size, max_size=size)).rstrip(b"\0") or b"\0"
    header = bytes((0xFD, len(payload), 0, 0, draw(byte), 1, 1))
    return sealed(header + number.to_bytes(3, "little") + payload, crc_extra=message.crc_extra)


@given(st.lists(any_packets(), min_size=1, max_size=4))
def test_a_datagram_of_several_packets_is_decoded_as_pymavlink_decodes_it(
    packets: list[bytes],
) -> None:
    codec = Codec(source_system=255, source_component=191)
    decoded = list(codec.decode_datagram(b"".join(packets)))
    expected = [message for packet in packets for message in by_pymavlink(packet)]
    assert repr(decoded) == repr(expected)  # NaN is equal to nothing


def test_the_usual_packets_take_the_fast_path() -> None:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    for message in (
        mav.attitude_quaternion_encode(7, 1, 0, 0, 0, 0, 0, 0),
        mav.local_position_ned_encode(7, 0, 0, 0, 0, 0, 0),
        mav.highres_imu_encode(7, 0, 0, -9.8, *[0.0] * 10, 7),
        mav.rc_channels_encode(7, 8, *[1500] * 18, 255),
        mav.heartbeat_encode(2, 3, 81, 2, 4),
        mav.vfr_hud_encode(0, 0, 0, 0, 0, 0),
    ):
        assert decode_packet(message.pack(mav)) is not None


# --- messages that pymavlink's dialect lacks; packets of a real PX4 1.18, system 4

IN_RTL = bytes.fromhex("fd0900004f0401b40100000004050000030005e05d")
ARMED = bytes.fromhex("fd0e00002404019a0100f3ca900134450000120000006604641c")
MISSING = [
    (IN_RTL, "CURRENT_MODE", CurrentMode(5 << 24 | 4 << 16, 3 << 16)),
    (ARMED, "EVENT", Event(0x190CAF3)),
]


@pytest.mark.parametrize(("data", "name", "body"), MISSING)
@pytest.mark.parametrize("is_signed", [False, True])
def test_what_pymavlink_does_not_know_is_decoded_here(
    data: bytes, name: str, body: Body, is_signed: bool
) -> None:
    if is_signed:
        data = signed(data, crc_extra={"CURRENT_MODE": 193, "EVENT": 160}[name])
    expected = ReceivedMessage(Endpoint(4, 1), data[4], name, body, data)
    codec = Codec(source_system=255, source_component=191)
    assert list(codec.decode_datagram(data)) == [expected]
    assert by_pymavlink(data) == [expected]  # a serial port, byte by byte
    heartbeat = dialect.MAVLink(None, srcSystem=4, srcComponent=1)
    around = heartbeat.heartbeat_encode(2, 12, 0, 0, 4).pack(heartbeat)
    assert [message.name for message in codec.decode(around + data + around)] == [
        *("HEARTBEAT", name, "HEARTBEAT")
    ]


def signed(data: bytes, *, crc_extra: int) -> bytes:
    """The packet with the flag and with room for a signature, which nobody can check."""
    body = bytes((data[0], data[1], 1, *data[3:-2]))
    checksum: int = dialect.x25crc(body[1:] + bytes((crc_extra,))).crc
    return body + checksum.to_bytes(2, "little") + bytes(13)


@pytest.mark.parametrize(("data", "name", "body"), MISSING)
def test_a_damaged_one_is_no_message(data: bytes, name: str, body: Body) -> None:
    for k in range(10, len(data)):
        damaged = bytes((*data[:k], data[k] ^ 0x10, *data[k + 1 :]))
        assert all(message.body is None for message in by_pymavlink(damaged)), (name, body)


# --- sound checksums, and yet no packet for the fast path


def sealed(data: bytes, *, crc_extra: int) -> bytes:
    """The bytes with the checksum that they should have."""
    checksum: int = dialect.x25crc(data[1:] + bytes((crc_extra,))).crc
    return data + checksum.to_bytes(2, "little")


@pytest.mark.parametrize(
    ("at", "value"),
    [(0, 0xFE), (2, 2), (9, 1), (1, 5)],
    ids=["marker of MAVLink 1", "unknown flag", "number beyond 16 bits", "shorter than it is"],
)
def test_a_header_that_says_something_else_is_left_to_pymavlink(at: int, value: int) -> None:
    position = dialect.MAVLink_local_position_ned_message
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    packet = bytearray(mav.local_position_ned_encode(7, 1, 2, 3, 4, 5, 6).pack(mav)[:-2])
    assert decode_packet(sealed(bytes(packet), crc_extra=position.crc_extra)) is not None
    packet[at] = value
    assert decode_packet(sealed(bytes(packet), crc_extra=position.crc_extra)) is None


def test_a_flag_that_is_not_the_one_of_a_signature_is_left_to_pymavlink() -> None:
    unknown = bytearray(signed(IN_RTL, crc_extra=193))
    unknown[2] = 2
    body = sealed(bytes(unknown[:-15]), crc_extra=193) + bytes(13)
    assert decode_packet(body) is None


def test_a_payload_beyond_the_layout_is_left_to_pymavlink() -> None:
    position = dialect.MAVLink_local_position_ned_message
    for length, is_taken in ((28, True), (29, False)):
        header = bytes((0xFD, length, 0, 0, 0, 1, 1, position.id, 0, 0))
        packet = sealed(header + bytes(length), crc_extra=position.crc_extra)
        assert (decode_packet(packet) is not None) is is_taken
