"""Datagrams are cut where pymavlink's own packets end, and nothing is read beyond their end."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.frames import frame_at, split_frames
from mavbridge.mavlink.codec.messages import Endpoint

HEARTBEAT_ID = 0


def packet(*, is_v1: bool = False, is_signed: bool = False) -> bytes:
    vehicle = dialect.MAVLink(None, srcSystem=7, srcComponent=9)
    if is_signed:
        vehicle.signing.secret_key = bytes(range(32))
        vehicle.signing.sign_outgoing = True
    vehicle.seq = 3  # odd: MAVLink 1 has it where MAVLink 2 has its flags
    return bytes(vehicle.heartbeat_encode(2, 3, 0x81, 5, 4).pack(vehicle, is_v1))


V1, V2, SIGNED = packet(is_v1=True), packet(), packet(is_signed=True)
EMPTY_V1 = bytes((0xFE, 0, 3, 7, 9, 200)) + b"\x12\x34"


@pytest.mark.parametrize("kinds", [[V1], [V2], [SIGNED], [V1, V2, SIGNED, V1], []])
def test_a_datagram_is_cut_into_its_packets(kinds: list[bytes]) -> None:
    frames, is_rest = split_frames(b"".join(kinds))
    assert [frame.data for frame in frames] == kinds
    assert not is_rest
    for frame in frames:
        assert (frame.source, frame.message_id) == (Endpoint(7, 9), HEARTBEAT_ID)
        assert frame.payload == V2[10:19]


@pytest.mark.parametrize("whole", [V1, V2, SIGNED])
def test_a_packet_that_is_cut_off_is_none_wherever_it_ends(whole: bytes) -> None:
    for length in range(1, len(whole)):
        assert split_frames(whole[:length]) == ([], True)
        frames, is_rest = split_frames(V2 + whole[:length])
        assert ([frame.data for frame in frames], is_rest) == ([V2], True)


def test_what_follows_a_byte_that_begins_no_packet_is_left_over() -> None:
    for marker in (0x00, 0xFC, 0xFF):
        frames, is_rest = split_frames(V1 + bytes((marker,)) + V2[1:])
        assert ([frame.data for frame in frames], is_rest) == ([V1], True)


def test_a_packet_without_a_payload_is_one() -> None:
    (frame,), is_rest = split_frames(EMPTY_V1)
    assert (frame.data, frame.payload, frame.message_id, is_rest) == (EMPTY_V1, b"", 200, False)


def test_a_number_of_three_bytes() -> None:
    data = bytes((0xFD, 1, 0, 0, 0, 7, 9, 0x01, 0x02, 0x03)) + b"x" + b"\x12\x34"
    frame = frame_at(data, 0)
    assert frame.message_id == 0x030201
