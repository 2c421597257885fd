import os
import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.transport.packet_pipe import PacketPipe

DEADLINE_S = 30.0


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


def test_a_second_of_a_busy_link_waits_in_the_pipe(stand: Stand) -> None:
    for _ in range(2_000):
        stand.log.put(Packet(0, bytes(60)))
    assert stand.log.dropped == 0


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


ORPHAN = """
import sys
from mavbridge.core.vehicle import Packet
from mavbridge.mavlink.transport.packet_pipe import PacketPipe
log = PacketPipe(int(sys.argv[1]), wall_offset_ns=0)
log.put(Packet(0, b"packet"))
print(log.dropped, sorted({"numpy", "torch", "pymavlink"} & set(sys.modules)))
"""


def test_a_process_of_its_own_survives_the_end_of_its_reader() -> None:
    """SIGPIPE would end it, were it not ignored; it is back at its default in a new process."""
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", ORPHAN, str(writer)],
        pass_fds=(writer,),
        env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=DEADLINE_S,
        check=False,
    )
    os.close(writer)
    assert done.returncode != -signal.SIGPIPE
    assert done.stdout == "1 []\n", done.stderr
