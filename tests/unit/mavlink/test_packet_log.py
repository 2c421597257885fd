import os
from datetime import datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v10 import ardupilotmega as dialect1

from helpers.wire import WireEnd
from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.transport.packet_pipe import PacketPipe


def packets(count: int) -> list[bytes]:
    """MAVLink 2, 1, 2 signed, and one of a message that no dialect knows, in turn."""
    end, old = WireEnd(), dialect1.MAVLink(None, srcSystem=1, srcComponent=1)
    signed = WireEnd()
    signed.mav.signing.secret_key = b"k" * 32
    signed.mav.signing.sign_outgoing = True
    signed.mav.signing.timestamp = 1
    unknown = bytes([0xFD, 5, 0, 0, 7, 1, 1, 0x39, 0x30, 0xFE]) + b"hello" + b"\x12\x34"
    made = []
    for k in range(count):
        match k % 4:
            case 0:
                made.append(end.pack(end.mav.attitude_encode(k, 0.1, 0.2, 0.3, 0, 0, 0)))
            case 1:
                made.append(bytes(old.attitude_encode(k, 0.1, 0.2, 0.3, 0, 0, 0).pack(old)))
            case 2:
                made.append(bytes(signed.pack(signed.mav.system_time_encode(1_000 + k, k))))
            case _:
                made.append(unknown)
    return made


def decoded(codec: Codec, pieces: list[bytes]) -> list[bytes]:
    return [message.packet for piece in pieces for message in codec.decode(piece)]


@given(st.lists(st.integers(1, 40), max_size=60), st.integers(1, 12))
def test_every_packet_comes_out_of_the_codec_as_it_was_sent(sizes: list[int], count: int) -> None:
    wanted = packets(count)
    data, pieces, at = b"".join(wanted), [], 0
    for size in [*sizes, len(data)]:
        pieces.append(data[at : at + size])
        at += size
    assert decoded(Codec(source_system=255, source_component=191), pieces) == wanted


def test_pymavlink_reads_the_log(tmp_path: Path) -> None:
    path = tmp_path / "link.tlog"
    unix_ns = 1_700_000_000_123_456_789
    fd = os.open(path, os.O_CREAT | os.O_WRONLY)
    log = PacketPipe(fd, wall_offset_ns=unix_ns - 5_000_000_000)
    end = WireEnd()
    for k in range(5):
        stamp_ns = 5_000_000_000 + k * 10_000_000
        sent = end.pack(end.mav.manual_control_encode(1, k, 0, 0, 0, 0))
        arrived = [Packet(stamp_ns, end.heartbeat()), Packet(stamp_ns, packets(1)[0])]
        for packet in (*arrived, Packet(stamp_ns + 2_000_000, sent)):
            log.put(packet)
    log.close()
    reader = mavutil.mavlogfile(str(path))
    read = []
    while (message := reader.recv_msg()) is not None:
        read.append(message)
    reader.f.close()
    assert [m.get_type() for m in read] == ["HEARTBEAT", "ATTITUDE", "MANUAL_CONTROL"] * 5
    assert [m.x for m in read[2::3]] == [0, 1, 2, 3, 4]
    assert read[2]._timestamp - read[0]._timestamp == pytest.approx(0.002, abs=1e-5)
    first = datetime.fromtimestamp(read[0]._timestamp)
    assert abs(first.timestamp() - unix_ns / 1e9) < 1e-4
