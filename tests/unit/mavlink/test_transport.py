"""Transports on loopback. A datagram on loopback is there when its send returns: nothing waits."""

import os
import pty
import select
import socket
import tty
from pathlib import Path

import pytest

from helpers.fakes import FakeClock
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.processes import free_port
from mavbridge.mavlink.transport.sockets import (
    TCP_SILENCE_NS,
    SerialTransport,
    TcpTransport,
    Transport,
    TransportDownError,
    UdpTransport,
    make_transport,
)


@pytest.mark.parametrize(
    ("spec", "kind"),
    [
        ("udp:127.0.0.1:14550", UdpTransport),
        ("udpin:0.0.0.0:14550", UdpTransport),
        ("udpout:localhost:14550", UdpTransport),
        ("127.0.0.1:14550", UdpTransport),
        ("tcp:127.0.0.1:5760", TcpTransport),
        ("/dev/ttyACM0,921600", SerialTransport),
        ("/dev/ttyACM0", SerialTransport),
    ],
)
def test_connection_strings(spec: str, kind: type) -> None:
    assert isinstance(make_transport(spec, FakeClock()), kind)


@pytest.mark.parametrize(
    "spec",
    [
        "",
        "udp:",
        "udp:host",
        "udp:host:0",
        "udp:host:99999",
        "tcp:1:x",
        "bluetooth",
        "/dev/ttyS0,fast",
        "ws:a:b:c",
    ],
)
def test_a_string_that_is_none_of_them_is_refused_with_the_forms(spec: str) -> None:
    with pytest.raises(UserError, match="HOST:PORT"):
        make_transport(spec, FakeClock())


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


def test_a_port_in_use_is_the_users_error() -> None:
    port = free_port()
    first = make_transport(f"udp:127.0.0.1:{port}", FakeClock())
    first.open()
    with pytest.raises(UserError, match=f"{port}.*stop it, or choose another port"):
        make_transport(f"udpin:127.0.0.1:{port}", FakeClock()).open()
    first.close()


def test_udp_to_nobody_is_no_error() -> None:
    ours = make_transport(f"udpout:127.0.0.1:{free_port()}", FakeClock())
    ours.open()
    for _ in range(3):
        ours.send(b"anyone?")
        assert list(ours.drain()) == []
    ours.close()


def drain_until(transport: Transport, wanted: bytes, clock: MonotonicClock) -> bytes:
    """TCP needs its handshake: look again until the bytes are there, for two seconds at most."""
    deadline_ns, data = clock.now_ns() + 2_000_000_000, b""
    while data != wanted and clock.now_ns() < deadline_ns:
        data += b"".join(chunk.data for chunk in transport.drain())
    return data


def test_tcp_connects_talks_and_notices_the_end() -> None:
    clock = MonotonicClock()
    with socket.create_server(("127.0.0.1", 0)) as server:
        ours = make_transport(f"tcp:127.0.0.1:{server.getsockname()[1]}", clock)
        ours.open()
        vehicle, _ = server.accept()
        with vehicle:
            vehicle.sendall(b"hello")
            assert drain_until(ours, b"hello", clock) == b"hello"
            ours.send(b"answer")
            assert vehicle.recv(100) == b"answer"
        with pytest.raises(TransportDownError, match="closed the connection"):
            drain_until(ours, b"more", clock)
    ours.close()


def test_tcp_refused_can_be_tried_again() -> None:
    clock = MonotonicClock()
    ours = make_transport(f"tcp:127.0.0.1:{free_port(socket.SOCK_STREAM)}", clock)

    def connect() -> None:  # the refusal may come at once, or with the first look
        ours.open()
        drain_until(ours, b"x", clock)

    for _ in range(2):
        with pytest.raises(TransportDownError, match="ECONNREFUSED"):
            connect()
        ours.close()


def test_serial_reads_and_writes_and_notices_the_end() -> None:
    clock = MonotonicClock()
    ours_fd, theirs_fd = pty.openpty()
    name = os.ttyname(theirs_fd)
    ours = SerialTransport(name, 115200, clock)
    ours.open()
    os.write(ours_fd, b"hello")
    assert drain_until(ours, b"hello", clock) == b"hello"
    ours.send(b"answer")
    assert os.read(ours_fd, 100) == b"answer"
    ours.close()
    os.close(theirs_fd)
    os.close(ours_fd)


def test_a_serial_port_that_does_not_exist_is_the_users_error(tmp_path: Path) -> None:
    ours = SerialTransport(str(tmp_path / "ttyNONE"), 115200, FakeClock())
    with pytest.raises(UserError, match=r"ttyNONE.*dialout"):
        ours.open()


def test_a_serial_port_that_nobody_reads_drops_whole_packets_and_never_blocks() -> None:
    ours_fd, theirs_fd = pty.openpty()
    tty.setraw(theirs_fd)
    ours = SerialTransport(os.ttyname(theirs_fd), 115200, MonotonicClock())
    ours.open()
    packet = bytes(range(100)) * 3
    taken = sum(ours.send(packet) for _ in range(1000))
    assert 0 < taken < 1000
    received = b""
    while select.select([ours_fd], [], [], 0)[0]:
        received += os.read(ours_fd, 65536)
        ours.send(b"")  # finishes the packet that was cut
    assert received == packet * (len(received) // len(packet))
    ours.close()
    os.close(theirs_fd)
    os.close(ours_fd)


def test_a_datagram_that_the_network_refuses_is_dropped() -> None:
    ours = UdpTransport(("255.255.255.255", 9), FakeClock(), listen=False)  # EACCES: a broadcast
    ours.open()
    assert ours.send(b"x") is False
    ours.close()


def test_a_silent_tcp_connection_is_taken_for_dead() -> None:
    clock = FakeClock()
    with socket.create_server(("127.0.0.1", 0)) as server:
        ours = make_transport(f"tcp:127.0.0.1:{server.getsockname()[1]}", clock)
        ours.open()
        vehicle, _ = server.accept()
        with vehicle:
            assert list(ours.drain()) == []
            clock.advance_ns(TCP_SILENCE_NS + 1)
            with pytest.raises(TransportDownError, match="silent for 5 s"):
                list(ours.drain())
        ours.close()


def test_a_host_that_does_not_exist_is_the_users_error() -> None:
    with pytest.raises(UserError, match="cannot find host"):
        make_transport("tcp:no.such.host.invalid:5760", FakeClock())
