"""Packets through the pipe to a telemetry log, which pymavlink and our own reader read."""

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.tlog import PacketPipe, read_tlog


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
    stand.log.put(0, bytes(1 << 14))  # what could be torn is dropped
    stand.log.put(11_000, b"first")
    stand.log.put(23_000, b"second")
    stand.log.close()
    assert stand.read() == bytes(7) + b"\x0cfirst" + bytes(7) + b"\x18second"
    assert stand.read() == b"", "the end"
    assert stand.log.dropped == 1


def test_a_full_pipe_drops_whole_records_and_counts_them(stand: Stand) -> None:
    offered = 0
    while stand.log.dropped < 3:
        stand.log.put(0, offered.to_bytes(4, "big") + bytes(276))
        offered += 1
    data, size = stand.read(), 8 + 280
    numbers = [int.from_bytes(data[at + 8 : at + 12], "big") for at in range(0, len(data), size)]
    assert numbers == [*range(offered - 3)]
    stand.log.put(0, b"there is room again")
    assert stand.read().endswith(b"there is room again")
    assert stand.log.dropped == 3


def test_after_the_reader_is_gone_everything_is_counted_and_nothing_is_raised() -> None:
    reader, writer = os.pipe()
    log = PacketPipe(writer, wall_offset_ns=0)
    os.close(reader)
    for _ in range(5):
        log.put(0, b"packet")
    log.close()
    log.close()
    log.put(0, b"late")
    assert log.dropped == 6


def test_a_log_that_is_not_there_is_told(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cannot be read"):
        read_tlog(tmp_path / "none.tlog")
