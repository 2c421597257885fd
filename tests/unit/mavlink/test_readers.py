"""Packets and payloads are read as pymavlink's own parser reads them, which is the other side."""

import struct
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.flown_vehicle import codec
from mavbridge.mavlink.codec.frames import checksum
from mavbridge.mavlink.codec.messages import Body, CurrentMode, Endpoint, Event, ReceivedMessage
from mavbridge.mavlink.codec.readers import IDS, READERS, UnusableError, _layout

byte = st.integers(0, 255)
number = st.floats(width=32) | st.just(0.0)


@st.composite
def packets(draw: st.DrawFn) -> bytes:
    """A sound packet of any message, with any payload; signed by nobody we know, or old."""
    mav = dialect.MAVLink(None, srcSystem=draw(byte), srcComponent=draw(byte))
    mav.seq = draw(byte)
    read = st.sampled_from(sorted(READERS)) | st.sampled_from(["VFR_HUD", "GPS_RAW_INT", "PING"])
    name = draw(read.filter(lambda name: IDS[name] in dialect.mavlink_map))
    kind = dialect.mavlink_map[IDS[name]]
    if draw(st.booleans()):
        mav.signing.secret_key, mav.signing.sign_outgoing = bytes(32), True
    size = kind.unpacker.size
    floats = struct.pack("<i24f", 7, *(draw(number) for _ in range(24)))
    payload = draw(st.just(floats) | st.binary(min_size=size, max_size=size))
    payload = payload[:size].ljust(size, b"\0")
    is_v1 = draw(st.booleans()) and kind.id < 256 and not mav.signing.sign_outgoing
    message = dialect.MAVLink_message(kind.id, name)
    return bytes(message._pack(mav, kind.crc_extra, payload, force_mavlink1=is_v1))


def by_pymavlink(data: bytes) -> ReceivedMessage:
    """The reader's record of the fields that pymavlink's own decoder finds."""
    message = dialect.MAVLink(None).decode(bytearray(data))
    name, body, is_unusable = message.get_type(), None, False
    fields = {
        field: getattr(message, f"_{field}_raw", getattr(message, field))
        for field in message.get_fieldnames()
    }
    if (reader := READERS.get(name)) is not None:
        try:
            body = reader(SimpleNamespace(**fields))
        except UnusableError:
            is_unusable = True
    source = Endpoint(message.get_srcSystem(), message.get_srcComponent())
    return ReceivedMessage(source, message.get_seq(), name, body, data, is_unusable)


@given(st.lists(packets(), min_size=1, max_size=4))
def test_a_datagram_is_decoded_as_pymavlink_decodes_it(sent: list[bytes]) -> None:
    expected = [by_pymavlink(packet) for packet in sent]
    decoded = list(codec().decode_datagram(b"".join(sent)))
    assert repr(decoded) == repr(expected)  # NaN is equal to nothing


@given(st.lists(packets() | st.binary(max_size=40), max_size=4), st.data())
def test_a_damaged_stream_is_cut_into_packets_as_pymavlink_cuts_it(
    sent: list[bytes], draws: st.DataObject
) -> None:
    data = bytearray(b"".join(sent))
    if data and draws.draw(st.booleans()):
        data[draws.draw(st.integers(0, len(data) - 1))] ^= draws.draw(st.integers(1, 255))
    cuts = sorted(draws.draw(st.lists(st.integers(0, len(data)), max_size=5)))
    pieces = [data[a:b] for a, b in zip([0, *cuts], [*cuts, len(data)], strict=True)]
    ours, theirs = codec(), dialect.MAVLink(None)
    theirs.robust_parsing = True
    expected = [m for piece in pieces for m in theirs.parse_buffer(piece) or ()]
    read = [message for piece in pieces for message in ours.decode(bytes(piece))]
    assert [message.packet for message in read] == [
        bytes(message.get_msgbuf()) for message in expected if message.get_type() != "BAD_DATA"
    ]
    unusable = sum(message.is_unusable for message in read)
    damaged = sum(message.get_type() == "BAD_DATA" for message in expected)
    assert damaged <= ours.bad_data_count <= damaged + unusable
    if read:
        assert [message.packet for message in codec().decode_datagram(read[0].packet)]


# --- messages that pymavlink's dialect lacks; packets of a real PX4 1.18, system 4

IN_RTL = bytes.fromhex("fd0900004f0401b40100000004050000030005e05d")
ARMED = bytes.fromhex("fd0e00002404019a0100f3ca900134450000120000006604641c")


@pytest.mark.parametrize(
    ("data", "name", "crc_extra", "body"),
    [
        (IN_RTL, "CURRENT_MODE", 193, CurrentMode(5 << 24 | 4 << 16, 3 << 16)),
        (ARMED, "EVENT", 160, Event(0x190CAF3, 18)),
    ],
)
@pytest.mark.parametrize("is_signed", [False, True])
def test_what_pymavlink_does_not_know_is_decoded_here(
    data: bytes, name: str, crc_extra: int, body: Body, is_signed: bool
) -> None:
    if is_signed:  # with room for a signature, which nobody can check
        flagged = bytes((data[0], data[1], 1, *data[3:-2]))
        data = flagged + checksum(flagged[1:], crc_extra) + bytes(13)
    (message,) = codec().decode_datagram(data)
    assert message == ReceivedMessage(Endpoint(4, 1), data[4], name, body, data, is_unusable=False)
    for k in range(10, len(data) - 13 * is_signed):
        damaged = bytes((*data[:k], data[k] ^ 0x10, *data[k + 1 :]))
        assert list(codec().decode_datagram(damaged)) == []


@pytest.mark.parametrize(
    ("at", "value"),
    [(0, 0xFE), (2, 2), (1, 5)],
    ids=["marker of MAVLink 1", "unknown flag", "shorter than it is"],
)
def test_a_header_that_says_something_else_is_no_packet(at: int, value: int) -> None:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    packet = bytearray(mav.local_position_ned_encode(7, 1, 2, 3, 4, 5, 6).pack(mav)[:-2])
    packet[at] = value
    crc_extra = dialect.MAVLink_local_position_ned_message.crc_extra
    data = bytes(packet) + checksum(bytes(packet[1:]), crc_extra)
    assert all(message.body is None for message in codec().decode_datagram(data))


def test_an_array_of_the_wire_is_one_field() -> None:
    assert _layout("M", "<I3BH", ("a", "b", "c"), (1, 3, 1)).pick((1, 2, 3, 4, 5)) == (
        *(1, (2, 3, 4), 5),
    )
    layout = _layout("M", "<IH", ("a", "b"))
    assert (layout.pick((1, 2)), layout.fields(1, 2).b, layout.payload.size) == ((1, 2), 2, 6)


@pytest.mark.parametrize("length", [28, 29])
def test_what_a_payload_has_beyond_its_layout_is_left_out(length: int) -> None:
    position = dialect.MAVLink_local_position_ned_message
    packet = bytes((0xFD, length, 0, 0, 0, 1, 1, position.id, 0, 0)) + bytes(length)
    (message,) = codec().decode_datagram(packet + checksum(packet[1:], position.crc_extra))
    assert message.body is not None
