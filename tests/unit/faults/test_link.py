"""Effect of a faulty link and of a serial carrier on packets, on a clock of the test."""

import os
import tty

import pytest

from faults.link import FaultyLink, LinkFaults, SerialCarrier
from sitl.clock import NS_PER_MS, Clock


class SetClock(Clock):
    """Stands where it is put."""

    at_ns = 0

    def now_ns(self) -> int:
        return self.at_ns


def lost(link: FaultyLink, count: int, period_ms: int) -> list[bool]:
    """For each packet of a regular stream, whether it was lost."""
    outcome = []
    for k in range(count):
        now_ns = k * period_ms * NS_PER_MS
        link.send(b"x", now_ns)
        outcome.append(not link.receive(now_ns))
    return outcome


def test_holes_swallow_every_packet_of_their_time_and_no_other() -> None:
    link = FaultyLink(LinkFaults(hole_ms=50.0, hole_every_ms=200.0), seed=1)
    text = "".join("x" if is_lost else "." for is_lost in lost(link, 2000, 5))
    holes = [hole for hole in text.split(".") if hole]
    assert 20 <= len(holes) <= 80
    assert {len(hole) for hole in holes[:-1]} == {10}  # packets of 5 ms in a hole of 50
    assert 0.1 < text.count("x") / len(text) < 0.3


def test_a_serial_carrier_passes_bytes_at_the_pace_of_its_baud_rate_and_may_stop_reading() -> None:
    clock = SetClock()
    carrier = SerialCarrier(57600, clock)
    name, _, baud = carrier.address.partition(",")
    assert baud == "57600"
    bridge = os.open(name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(bridge)
    os.write(bridge, bytes(1000))
    carrier.send(bytes(1000))
    clock.at_ns += 100 * NS_PER_MS
    assert [len(data) for data in carrier.receive()] == [576]
    assert len(os.read(bridge, 4096)) == 576
    carrier.is_read = False
    clock.at_ns += 100 * NS_PER_MS
    assert carrier.receive() == []
    carrier.fail()
    carrier.receive()
    with pytest.raises(OSError, match="Input/output error"):
        os.write(bridge, b"x")
    os.close(bridge)
    carrier.close()
