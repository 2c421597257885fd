import os
from collections.abc import Iterator

import pytest

from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.transport.packet_pipe import PacketPipe


class Stand:
    """A log and the other end of its pipe."""

    def __init__(self) -> None:
        self.reader, writer = os.pipe()
        self.log = PacketPipe(writer, wall_offset_ns=1_000)

    def read(self) -> bytes:
        return os.read(self.reader, 1 << 22)


@pytest.fixture
def stand() -> Iterator[Stand]:
    made = Stand()
    yield made
    made.log.close()
    os.close(made.reader)


def test_a_record_is_the_time_of_the_packet_and_the_packet(stand: Stand) -> None:
    stand.log.put(Packet(11_000, b"first"))
    stand.log.put(Packet(23_000, b"second"))
    stand.log.close()
    assert stand.read() == bytes(7) + b"\x0cfirst" + bytes(7) + b"\x18second"
    assert stand.read() == b"", "the end"
    assert stand.log.dropped == 0


def test_a_full_pipe_drops_whole_records_and_counts_them(stand: Stand) -> None:
    offered = 0
    while stand.log.dropped < 3:
        stand.log.put(Packet(0, offered.to_bytes(4, "big") + bytes(276)))
        offered += 1
    data = stand.read()
    size = 8 + 280
    assert len(data) == (offered - 3) * size
    assert [int.from_bytes(data[at + 8 : at + 12], "big") for at in range(0, len(data), size)] == [
        *range(offered - 3)
    ]
    stand.log.put(Packet(0, b"there is room again"))
    assert stand.read().endswith(b"there is room again")
    assert stand.log.dropped == 3


def test_after_the_reader_is_gone_everything_is_counted_and_nothing_is_raised() -> None:
    reader, writer = os.pipe()
    log = PacketPipe(writer, wall_offset_ns=0)
    os.close(reader)
    for _ in range(5):
        log.put(Packet(0, b"packet"))
    log.close()
    log.close()
    log.put(Packet(0, b"late"))
    assert log.dropped == 6


def test_what_could_be_torn_is_dropped(stand: Stand) -> None:
    stand.log.put(Packet(0, bytes(1 << 14)))
    stand.log.put(Packet(0, b"whole"))
    assert stand.read() == bytes(8) + b"whole"
    assert stand.log.dropped == 1
