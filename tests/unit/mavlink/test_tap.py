from datetime import datetime
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink import mavutil
from pymavlink.dialects.v10 import ardupilotmega as dialect1
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.wire import WireEnd
from mavbridge.core.records import Packet
from mavbridge.mavlink.transport import tap
from mavbridge.mavlink.transport.sockets import Chunk
from mavbridge.mavlink.transport.tap import Framer, PacketTap
from mavbridge.recording.tlog import TlogWriter

PEER = ("127.0.0.1", 14550)


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


@given(st.lists(st.integers(1, 40), min_size=1, max_size=60), st.integers(1, 12))
def test_a_stream_is_cut_into_its_packets_however_it_comes(sizes: list[int], count: int) -> None:
    wanted = packets(count)
    data, framer, got, at = b"".join(wanted), Framer(), [], 0
    for size in [*sizes, len(data)]:
        got += framer.feed(data[at : at + size], is_datagram=False)
        at += size
    assert got == wanted


@given(st.binary(max_size=30), st.integers(0, 200))
def test_garbage_costs_no_packet_that_follows(garbage: bytes, flipped: int) -> None:
    wanted = [p for k, p in enumerate(packets(8)) if k % 4 != 3]
    broken = bytearray(wanted[0])
    broken[flipped % len(broken)] ^= 0x41
    framer = Framer()
    framer.feed(garbage + bytes(broken), is_datagram=True)
    got = [p for data in wanted for p in framer.feed(data, is_datagram=True)]
    assert got == wanted


def test_a_datagram_may_hold_several() -> None:
    wanted = packets(7)
    assert Framer().feed(b"".join(wanted), is_datagram=True) == wanted


def test_a_full_tap_drops_and_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tap, "CAPACITY", 3)
    full = PacketTap()
    (data,) = packets(1)
    for _ in range(5):
        full.received(Chunk(data, 1, PEER))
    for _ in range(4):
        full.sent(data, 2)
    assert full.dropped == 2 + 1
    assert full.drain() == [Packet(2, data)] * 3 + [Packet(1, data)] * 3
    assert full.drain() == []


def test_pymavlink_reads_the_log(tmp_path: Path) -> None:
    path = tmp_path / "link.tlog"
    unix_ns = 1_700_000_000_123_456_789
    link = PacketTap()
    end = WireEnd()
    for k in range(5):
        stamp_ns = 5_000_000_000 + k * 10_000_000
        link.received(Chunk(end.heartbeat() + packets(1)[0], stamp_ns, PEER))
        link.sent(end.pack(end.mav.manual_control_encode(1, k, 0, 0, 0, 0)), stamp_ns + 2_000_000)
    log = TlogWriter(path, wall_offset_ns=unix_ns - 5_000_000_000)
    log.append(link.drain())
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
    assert reader._link == 0
    assert dialect.WIRE_PROTOCOL_VERSION == "2.0"
