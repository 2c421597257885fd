"""Transports on loopback. A datagram on loopback is there when its send returns: nothing waits."""

import errno
import os
import pty
import re
import select
import socket
import sys
import tty
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path

import pytest
import serial

from helpers.fakes import FakeClock
from helpers.network import needs_ipv6
from mavbridge.core.address import spelled
from mavbridge.core.clock import Clock, MonotonicClock
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.processes import free_port
from mavbridge.mavlink.transport import sockets
from mavbridge.mavlink.transport.holders import device_holder, udp_holder
from mavbridge.mavlink.transport.sockets import (
    TCP_SILENCE_NS,
    SerialTransport,
    Transport,
    TransportDownError,
    UdpTransport,
    make_transport,
)

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


def test_udp_listens_answers_whom_it_is_told_and_stamps_arrival() -> None:
    port, clock = free_port(), MonotonicClock()
    ours = make_transport(f"udp:127.0.0.1:{port}", clock)
    ours.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.bind(("127.0.0.1", 0))
        before_ns = clock.now_ns()
        vehicle.sendto(b"one", ("127.0.0.1", port))
        vehicle.sendto(b"two", ("127.0.0.1", port))
        after_ns = clock.now_ns()
        first, second = ours.drain()
        assert (first.data, second.data) == (b"one", b"two")
        # The kernel stamps with another clock; the two are not read at quite the same time.
        slack_ns = 50_000_000
        assert before_ns - slack_ns <= first.arrived_ns <= after_ns + slack_ns
        assert before_ns - slack_ns <= second.arrived_ns <= after_ns + slack_ns
        assert list(ours.drain()) == []
        assert not ours.send(b"to nobody yet")
        assert ours.send(b"hello", first.sender)
        assert vehicle.recv(100) == b"hello"
    ours.close()
    ours.close()


def test_udp_without_stamps_of_the_kernel_is_stamped_when_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As under an emulator of Linux, which refuses the option."""
    monkeypatch.setattr(sockets, "_SO_TIMESTAMPNS", 9999)
    port, clock = free_port(), FakeClock()
    ours = make_transport(f"udp:127.0.0.1:{port}", clock)
    ours.open()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
        vehicle.sendto(b"one", ("127.0.0.1", port))
        (heard,) = ours.drain()
    assert (heard.data, heard.arrived_ns) == (b"one", clock.now_ns())
    ours.close()


@pytest.mark.parametrize(
    ("host", "called"),
    [
        ("127.0.0.1", "127.0.0.1"),
        *(pytest.param(host, "[::1]", marks=needs_ipv6) for host in ("[::1]", "[::]")),
    ],
)
def test_udp_listens_and_calls(host: str, called: str) -> None:
    port = free_port()
    ours = make_transport(f"udp:{host}:{port}", FakeClock())
    vehicle = make_transport(f"udpout:{called}:{port}", FakeClock())
    vehicle.open()
    for _ in range(3):  # nobody listens yet: no error
        vehicle.send(b"anyone?")
        assert list(vehicle.drain()) == []
    ours.open()
    assert vehicle.send(b"hello")
    (heard,) = ours.drain()
    assert (heard.data, heard.sender[0]) == (b"hello", called.strip("[]"))
    assert ours.send(b"sticks", heard.sender)
    (answer,) = vehicle.drain()
    assert (answer.data, answer.sender[:2]) == (b"sticks", (called.strip("[]"), port))
    with pytest.raises(UserError, match=rf"cannot use udp {re.escape(host)}:{port}"):
        make_transport(f"udp:{host}:{port}", FakeClock()).open()
    ours.close()
    vehicle.close()


def test_a_computer_without_ipv6_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> socket.socket:
        raise OSError(errno.EAFNOSUPPORT, os.strerror(errno.EAFNOSUPPORT))

    transport = make_transport("udp:[::1]:14550", FakeClock())
    monkeypatch.setattr(socket, "socket", refuse)
    with pytest.raises(UserError, match=r"\[::1\]:14550: Address family not supported"):
        transport.open()


def test_a_port_in_use_is_the_users_error_and_says_whose_it_is() -> None:
    port = free_port()
    first = make_transport(f"udp:127.0.0.1:{port}", FakeClock())
    first.open()
    with pytest.raises(UserError, match=f"{port}.*stop it, or choose another port") as caught:
        make_transport(f"udpin:127.0.0.1:{port}", FakeClock()).open()
    if sys.platform == "linux":
        assert f"process {os.getpid()} (" in str(caught.value)
    first.close()


def processes(root: Path, *, command: str) -> Path:
    """A /proc in which process 42 is bound to port 14550, and nobody to another."""
    (root / "net").mkdir()
    line = "  1: 0100007F:38D6 00000000:0000 07 00000000:00000000 00:00000000 00000000  0  0 9876 2"
    (root / "net" / "udp").write_text("  sl  local_address ...\n" + line + "\n")
    for number, target in (("41", "socket:[1111]"), ("42", "socket:[9876]")):
        (root / number / "fd").mkdir(parents=True)
        (root / number / "fd" / "5").symlink_to(target)
        (root / number / "cmdline").write_text(command.replace(" ", "\0") + "\0")
    (root / "43").mkdir()  # of another user, or ended meanwhile
    return root


def test_the_holder_of_a_port_or_a_device_is_named_and_a_guard_waited_for(tmp_path: Path) -> None:
    proc = processes(tmp_path, command="nc -ul 14550")
    assert udp_holder(14550, proc) == "process 42 (nc -ul 14550) has it: stop it"
    assert udp_holder(14551, proc) == "another program listens there: stop it"
    assert udp_holder(14550, tmp_path / "none") == "another program listens there: stop it"
    (proc / "42" / "fd" / "6").symlink_to("/dev/ttyACM0")
    assert device_holder("/dev/ttyACM0", proc) == "; process 42 (nc -ul 14550) has it: stop it"
    assert device_holder("/dev/ttyACM1", proc) == ""
    guard = "python -m mavbridge.guard --connect udp:0.0.0.0:14550"
    (proc / "42" / "cmdline").write_text(guard.replace(" ", "\0"))
    advice = udp_holder(14550, proc)
    assert "process 42: python -m mavbridge.guard" in advice
    assert "giving the sticks back: wait until it has, stop it with kill 42" in advice


@pytest.mark.parametrize("spec", ["udp:127.0.0.1:{}", "udpout:127.0.0.1:{}", "tcp:127.0.0.1:{}"])
def test_the_descriptor_wakes_a_select_while_it_is_open(spec: str) -> None:
    port = free_port()
    ours = make_transport(spec.format(port), FakeClock())
    assert ours.fileno() is None
    with socket.create_server(("127.0.0.1", port)):
        ours.open()
        descriptor = ours.fileno()
        assert descriptor is not None
        assert not select.select([descriptor], [], [], 0)[0]
        if spec.startswith("udp:"):
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle:
                vehicle.sendto(b"wake", ("127.0.0.1", port))
            assert select.select([descriptor], [], [], 2)[0]
    ours.close()
    assert ours.fileno() is None


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
        vehicle.sendall(b"hello")
        assert drain_until(ours, b"hello", clock) == b"hello"
        ours.send(b"answer")
        assert vehicle.recv(100) == b"answer"
        vehicle.close()
        with pytest.raises(TransportDownError, match="closed the connection"):
            drain_until(ours, b"more", clock)


def test_a_reader_may_leave_the_rest_of_a_tcp_backlog_for_later() -> None:
    clock, sent = MonotonicClock(), bytes(k % 251 for k in range(20_000))
    with tcp_pair(clock) as (ours, vehicle):
        vehicle.sendall(sent)
        first = drain_first(ours, clock)
        assert 0 < len(first) <= 2048
        assert first + drain_until(ours, sent[len(first) :], clock) == sent


def drain_first(transport: Transport, clock: MonotonicClock) -> bytes:
    """The first piece of what comes, waited for like ``drain_until``."""
    deadline_ns = clock.now_ns() + 2_000_000_000
    while clock.now_ns() < deadline_ns:
        for chunk in transport.drain():
            return chunk.data
    return b""


@pytest.mark.parametrize("host", ["127.0.0.1", pytest.param("[::1]", marks=needs_ipv6)])
def test_tcp_refused_at_the_start_is_one_clear_error(host: str) -> None:
    port = free_port(socket.SOCK_STREAM)
    ours = make_transport(f"tcp:{host}:{port}", MonotonicClock())
    with pytest.raises(PeerError, match=rf"tcp {re.escape(host)}:{port}: nobody listens there"):
        ours.open()
    assert ours.fileno() is None


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
        with pytest.raises(TransportDownError, match="ECONNREFUSED"):
            connect()
        ours.close()


def test_serial_reads_and_writes_and_notices_the_end(open_serial: OpenSerial) -> None:
    clock = MonotonicClock()
    fd, ours = open_serial(115200, clock)
    os.write(fd, b"hello")
    assert drain_until(ours, b"hello", clock) == b"hello"
    ours.send(b"answer")
    assert os.read(fd, 100) == b"answer"


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


def test_what_a_drain_has_left_of_a_serial_backlog_is_not_lost(open_serial: OpenSerial) -> None:
    fd, ours = open_serial(57600, FakeClock())
    os.write(fd, bytes(100))
    first = next(iter(ours.drain()))
    os.write(fd, bytes(range(100)))
    rest = b"".join(chunk.data for chunk in [*ours.drain(), *ours.drain()])
    assert first.data + rest == bytes(100) + bytes(range(100))


def test_a_serial_device_that_is_unplugged_is_noticed() -> None:
    ours_fd, theirs_fd = pty.openpty()
    ours = SerialTransport(os.ttyname(theirs_fd), 57600, MonotonicClock())
    ours.open()
    os.close(theirs_fd)
    os.close(ours_fd)
    with pytest.raises(TransportDownError, match="serial"):
        drain_until(ours, b"x", MonotonicClock())
    ours.close()


def test_a_serial_port_that_does_not_exist_is_the_users_error(tmp_path: Path) -> None:
    ours = SerialTransport(str(tmp_path / "ttyNONE"), 115200, FakeClock())
    with pytest.raises(UserError, match=r"ttyNONE.*there is no such port"):
        ours.open()


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


def test_a_datagram_that_the_network_refuses_is_dropped() -> None:
    ours = UdpTransport(("255.255.255.255", 9), FakeClock(), listen=False)  # EACCES: a broadcast
    ours.open()
    assert ours.send(b"x") is False
    ours.close()


def test_a_silent_tcp_connection_is_taken_for_dead() -> None:
    clock = FakeClock()
    with tcp_pair(clock) as (ours, _):
        assert list(ours.drain()) == []
        clock.advance_ns(TCP_SILENCE_NS + 1)
        with pytest.raises(TransportDownError, match="silent for 5 s"):
            list(ours.drain())


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
