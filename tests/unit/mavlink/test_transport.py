"""Transports on loopback. A datagram on loopback is there when its send returns: nothing waits."""

import os
import pty
import re
import select
import socket
import sys
import termios
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from typing import Any

import pytest
import serial

from helpers.fakes import FakeClock
from helpers.wire import needs_ipv6
from mavbridge.core.address import spelled
from mavbridge.core.clock import Clock, MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.processes import free_port
from mavbridge.mavlink.transport.connection import Transport, TransportDownError
from mavbridge.mavlink.transport.sockets import TCP_SILENCE_NS, SerialTransport, make_transport

Stream = tuple[Transport, Callable[[bytes], object], Callable[[int], bytes]]
"""Our end of a stream, and the vehicle's ways to write and to read."""
OpenSerial = Callable[[int, Clock], tuple[int, SerialTransport]]


@pytest.fixture
def open_serial() -> Iterator[OpenSerial]:
    """Open a port of this baud rate; the other end of its cable comes with it."""
    with ExitStack() as opened:

        def make(baud: int, clock: Clock) -> tuple[int, SerialTransport]:
            ours_fd, theirs_fd = pty.openpty()
            tty.setraw(theirs_fd)
            ours = SerialTransport(os.ttyname(theirs_fd), baud, clock)
            ours.open()
            for close in (partial(os.close, ours_fd), partial(os.close, theirs_fd), ours.close):
                opened.callback(close)
            return ours_fd, ours

        yield make


@contextmanager
def tcp_pair(clock: Clock, host: str = "127.0.0.1") -> Iterator[tuple[Transport, socket.socket]]:
    """Our end of a connection, and the vehicle's."""
    kind = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, 0), family=kind) as server:
        ours = make_transport(f"tcp:{spelled(host, server.getsockname()[1])}", clock)
        ours.open()
        vehicle, _ = server.accept()
        with vehicle:
            yield ours, vehicle
        ours.close()


@pytest.mark.parametrize(
    ("host", "called"),
    [
        ("127.0.0.1", "127.0.0.1"),
        *(pytest.param(host, "[::1]", marks=needs_ipv6) for host in ("[::1]", "[::]")),
    ],
)
def test_udp_listens_and_calls(host: str, called: str) -> None:
    port, clock = free_port(), MonotonicClock()
    ours = make_transport(f"udp:{host}:{port}", clock)
    vehicle = make_transport(f"udpout:{called}:{port}", FakeClock())
    vehicle.open()
    for _ in range(3):  # nobody listens yet: no error
        vehicle.send(b"anyone?")
        assert list(vehicle.drain()) == []
    ours.open()
    assert vehicle.send(b"hello")
    (heard,) = ours.drain()
    assert (heard.data, heard.sender[0]) == (b"hello", called.strip("[]"))
    assert abs(clock.now_ns() - heard.arrived_ns) < 50_000_000  # by a clock of the kernel
    assert not ours.send(b"to nobody")
    assert ours.send(b"sticks", heard.sender)
    (answer,) = vehicle.drain()
    assert (answer.data, answer.sender[:2]) == (b"sticks", (called.strip("[]"), port))
    with pytest.raises(UserError, match=rf"cannot use udp {re.escape(host)}:{port}.*stop the prog"):
        make_transport(f"udp:{host}:{port}", FakeClock()).open()
    ours.close()
    vehicle.close()


def drain_until(transport: Transport, wanted: bytes, clock: MonotonicClock) -> bytes:
    """TCP needs its handshake: look again until the bytes are there, for two seconds at most."""
    deadline_ns, data = clock.now_ns() + 2_000_000_000, b""
    while data != wanted and clock.now_ns() < deadline_ns:
        data += b"".join(chunk.data for chunk in transport.drain())
    return data


@pytest.mark.parametrize("host", ["127.0.0.1", pytest.param("::1", marks=needs_ipv6)])
def test_tcp_connects_talks_and_notices_the_end(host: str) -> None:
    clock = MonotonicClock()
    with tcp_pair(clock, host) as (ours, vehicle):
        ours.send(b"answer")
        assert vehicle.recv(100) == b"answer"
        vehicle.close()
        with pytest.raises(TransportDownError, match="closed the connection"):
            drain_until(ours, b"more", clock)


def test_tcp_refused_later_can_be_tried_again() -> None:
    clock = MonotonicClock()
    with socket.create_server(("127.0.0.1", 0)) as server:
        ours = make_transport(f"tcp:127.0.0.1:{server.getsockname()[1]}", clock)
        ours.open()
        ours.close()

    def connect() -> None:  # the refusal may come at once, or with the first look
        ours.open()
        drain_until(ours, b"x", clock)

    for _ in range(2):
        with pytest.raises(TransportDownError, match="refused"):
            connect()
        ours.close()


@pytest.fixture(params=["tcp", "serial"])
def stream(request: pytest.FixtureRequest, open_serial: OpenSerial) -> Iterator[Stream]:
    clock = MonotonicClock()
    if request.param == "serial":
        fd, ours = open_serial(115200, clock)
        yield ours, partial(os.write, fd), partial(os.read, fd)
        return
    with tcp_pair(clock) as (ours, vehicle):
        yield ours, vehicle.sendall, vehicle.recv


def test_a_stream_reads_and_writes_and_a_reader_may_leave_the_rest_for_later(
    stream: Stream,
) -> None:
    ours, put, get = stream
    sent, clock = bytes(k % 251 for k in range(4000)), MonotonicClock()
    put(sent)
    first = b""
    while not first:
        first = next((chunk.data for chunk in ours.drain()), b"")
    assert 0 < len(first) <= 2048
    assert first + drain_until(ours, sent[len(first) :], clock) == sent
    ours.send(b"answer")
    assert get(100) == b"answer"


def test_a_serial_backlog_is_drained_to_its_end_with_the_times_it_took_to_come(
    open_serial: OpenSerial,
) -> None:
    clock = FakeClock()
    fd, ours = open_serial(57600, clock)
    sent = bytes(k % 251 for k in range(9000))
    assert os.write(fd, sent) == len(sent)
    clock.advance_ns(10_000_000_000)
    chunks = list(ours.drain())
    assert b"".join(chunk.data for chunk in chunks) == sent
    assert list(ours.drain()) == []
    byte_ns, seen = 10 * 1_000_000_000 // 57600, 0
    for chunk in chunks:
        seen += len(chunk.data)
        assert chunk.arrived_ns == clock.now_ns() - (len(sent) - seen) * byte_ns
        assert len(chunk.data) * byte_ns <= 2_000_000
    # What came since the port was last seen empty cannot have come before that.
    empty_ns = clock.now_ns()
    clock.advance_ns(10_000_000)
    assert os.write(fd, sent[:2000]) == 2000
    stamps = [chunk.arrived_ns for chunk in ours.drain()]
    assert (stamps[0], stamps[-1]) == (empty_ns, clock.now_ns())
    assert stamps == sorted(stamps)


def test_a_serial_device_that_is_unplugged_is_noticed() -> None:
    ours_fd, theirs_fd = pty.openpty()
    ours = SerialTransport(os.ttyname(theirs_fd), 57600, MonotonicClock())
    ours.open()
    os.close(theirs_fd)
    os.close(ours_fd)
    with pytest.raises(TransportDownError, match="serial"):
        drain_until(ours, b"x", MonotonicClock())
    ours.close()


def test_a_serial_device_that_goes_while_it_is_opened_again_can_be_tried_once_more(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ours_fd, theirs_fd = pty.openpty()
    ours = SerialTransport(os.ttyname(theirs_fd), 57600, MonotonicClock())
    ours.open()
    ours.close()
    read = termios.tcgetattr

    def unplugged_after(fd: int) -> list[Any]:
        settings = read(fd)
        os.close(ours_fd)
        return settings

    monkeypatch.setattr(termios, "tcgetattr", unplugged_after)
    with pytest.raises(TransportDownError, match=r"/dev/\S+: Input/output error$"):
        ours.open()
    os.close(theirs_fd)


def test_a_serial_port_that_nobody_reads_drops_whole_packets_and_never_blocks(
    open_serial: OpenSerial,
) -> None:
    fd, ours = open_serial(115200, MonotonicClock())
    packet = bytes(range(100)) * 3
    taken = sum(ours.send(packet) for _ in range(1000))
    assert 0 < taken < 1000
    received = b""
    while select.select([fd], [], [], 0)[0]:
        received += os.read(fd, 65536)
        ours.send(b"")  # finishes the packet that was cut
    assert received == packet * (len(received) // len(packet))


def test_a_silent_tcp_connection_is_taken_for_dead() -> None:
    clock = FakeClock()
    with tcp_pair(clock) as (ours, _):
        assert list(ours.drain()) == []
        clock.advance_ns(TCP_SILENCE_NS + 1)
        with pytest.raises(TransportDownError, match="silent for 5 s") as down:
            list(ours.drain())
    assert down.value.is_silence  # a busy simulator, perhaps: no loss that explains it


@pytest.mark.parametrize("is_read", [False, True])
def test_a_serial_port_throws_away_what_would_be_stale_and_nothing_else(
    monkeypatch: pytest.MonkeyPatch, open_serial: OpenSerial, is_read: bool
) -> None:
    """The far side stops reading for a second, or always lets a little wait.

    No byte older than 100 ms is sent after it.
    """
    clock, waiting, sent = FakeClock(), bytearray(), bytearray()
    _, ours = open_serial(115200, clock)

    def write(_descriptor: int, data: bytes) -> int:
        waiting.extend(data)
        sent.extend(data)
        return len(data)

    def reset(_port: object) -> None:
        waiting.clear()
        sent.clear()

    monkeypatch.setattr("mavbridge.mavlink.transport.sockets.os.write", write)
    monkeypatch.setattr(serial.Serial, "out_waiting", property(lambda _port: len(waiting)))
    monkeypatch.setattr(serial.Serial, "reset_output_buffer", reset)
    for tick in range(100):
        assert ours.send(bytes([tick]) * 30)
        assert min(waiting) >= tick - 10
        clock.advance_ns(10_000_000)
        if is_read:
            del waiting[:-50]
    assert waiting
    assert (len(sent) == 3000) is is_read


@pytest.mark.skipif(sys.platform != "linux", reason="TCP_USER_TIMEOUT is Linux's")
def test_sent_bytes_that_nobody_confirms_end_a_tcp_connection_after_half_a_second() -> None:
    clock = MonotonicClock()
    with tcp_pair(clock) as (ours, vehicle):
        vehicle.sendall(b"hello")
        assert drain_until(ours, b"hello", clock) == b"hello"
        fd = ours.fileno()
        assert fd is not None
        with socket.fromfd(fd, socket.AF_INET, socket.SOCK_STREAM) as handle:
            assert handle.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 500


def test_a_host_that_does_not_exist_is_the_users_error() -> None:
    with pytest.raises(UserError, match="cannot find host"):
        make_transport("tcp:no.such.host.invalid:5760", FakeClock())
