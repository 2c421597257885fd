"""Receiver values by UDP: ArduPilot SITL's RC input."""

import socket
import struct
from contextlib import closing

import pytest

from sitl import UsageError
from sitl.link.transport import RcInput

PWM = (1500, 1501, 1000, 1499, 1800, 1200, 1500, 1900)


@pytest.fixture
def free_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture
def transmitter(free_port):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as transmitter:
        transmitter.connect(("127.0.0.1", free_port))
        yield transmitter


@pytest.mark.parametrize("values", [PWM, (*PWM, *PWM)])
def test_8_or_16_values_arrive(free_port, transmitter, values):
    with closing(RcInput(free_port)) as rc_input:
        assert rc_input.latest() is None
        transmitter.send(struct.pack(f"<{len(values)}H", *values))

        assert rc_input.latest() == values
        assert rc_input.latest() is None


def test_the_newest_counts_and_other_sizes_are_ignored(free_port, transmitter):
    with closing(RcInput(free_port)) as rc_input:
        for data in (struct.pack("<8H", *[1100] * 8), struct.pack("<8H", *PWM), b"", b"x" * 31):
            transmitter.send(data)

        assert rc_input.latest() == PWM


def test_a_taken_port_is_named(free_port):
    with closing(RcInput(free_port)), pytest.raises(UsageError, match=f"--rc-in {free_port}"):
        RcInput(free_port)
