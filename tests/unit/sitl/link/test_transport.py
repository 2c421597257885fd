"""Real sockets on loopback, without waiting: what was sent is there when the kernel says so."""

import socket
import struct
from contextlib import closing, suppress

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from mavbridge.core.processes import free_port
from sitl import UsageError
from sitl.clock import NS_PER_S, Clock
from sitl.link.transport import FOLLOWER_KINDS, MAX_PEERS, RcInput, open_transport

DEADLINE_S = 5.0
STAMP_ATTEMPTS = 10
UNREAD_NS = 80_000_000
"""How long a datagram waits in the socket, so that its arrival and its reading differ."""


def drain_until(transport, count):
    """At least ``count`` reads, by a deadline."""
    clock = Clock()
    end_ns = clock.now_ns() + round(DEADLINE_S * NS_PER_S)
    received = []
    while len(received) < count and clock.now_ns() < end_ns:
        received += transport.drain()
    return received


def udp_client():
    client = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    client.bind(("127.0.0.1", 0))
    client.settimeout(DEADLINE_S)
    return client


FRAME = mav.MAVLink_timesync_message(0, 1).pack(mav.MAVLink(None))


def test_arrival_is_stamped_when_it_came_not_when_it_was_read():
    clock = Clock()
    margin_ns = UNREAD_NS // 2  # two clocks are read in turn when the stamp is converted
    with udp_client() as ground:
        url = f"udpin:127.0.0.1:{free_port()}"
        with closing(open_transport(url, clock)) as link:
            address = ("127.0.0.1", int(url.rpartition(":")[2]))
            # The kernel turns its stamps on in the background: the first may still be of the read.
            for _ in range(STAMP_ATTEMPTS):
                before_ns = clock.now_ns()
                ground.sendto(b"a", address)
                sent_ns = clock.now_ns()
                clock.sleep_until_ns(sent_ns + UNREAD_NS)
                (received,) = drain_until(link, 1)
                if received.arrived_ns <= sent_ns + margin_ns:
                    break
    assert before_ns - margin_ns <= received.arrived_ns <= sent_ns + margin_ns


def test_udpin_answers_everybody_it_has_heard_and_forgets_the_oldest():
    port = free_port()
    grounds = [udp_client() for _ in range(MAX_PEERS + 1)]
    with closing(open_transport(f"udpin:127.0.0.1:{port}", Clock())) as link:
        link.send(FRAME)
        for ground in grounds:
            ground.sendto(b"hello", ("127.0.0.1", port))
            drain_until(link, 1)
        link.send(FRAME)
        assert all(ground.recv(2048) == FRAME for ground in grounds[1:])
        grounds[0].setblocking(False)
        with pytest.raises(BlockingIOError):
            grounds[0].recv(2048)
    for ground in grounds:
        ground.close()


def test_tcp_clients_come_and_go():
    port = free_port(socket.SOCK_STREAM)
    with closing(open_transport(f"tcpin:127.0.0.1:{port}", Clock())) as link:
        for greeting in (b"first", b"second"):
            with socket.create_connection(("127.0.0.1", port), DEADLINE_S) as client:
                client.sendall(greeting)
                (received,) = drain_until(link, 1)
                assert received.data == greeting
                link.send(FRAME)
                assert client.recv(2048) == FRAME


def test_a_tcp_client_connects_to_send_and_again_after_the_connection_is_lost():
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(0.05)
        url = f"tcp:127.0.0.1:{server.getsockname()[1]}"
        with closing(open_transport(url, Clock(), FOLLOWER_KINDS)) as link:
            assert list(link.drain()) == []
            for greeting in (b"first", b"second"):
                with accept_while_sending(server, link, greeting) as accepted:
                    accepted.settimeout(DEADLINE_S)
                    assert accepted.recv(100) == greeting
                    accepted.sendall(b"answer to " + greeting)
                    (received,) = drain_until(link, 1)
                    assert received.data == b"answer to " + greeting


def accept_while_sending(server, link, data):
    """A send before the end of a lost connection was read is lost with it."""
    for _ in range(round(DEADLINE_S / server.gettimeout())):
        assert list(link.drain()) == []
        link.send(data)
        with suppress(TimeoutError):
            return server.accept()[0]
    raise AssertionError(f"no connection within {DEADLINE_S} s")


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udp:1",
        "foo:127.0.0.1:1",
        "udpin:127.0.0.1",
        "udpin:127.0.0.1:x",
        "udpout:host..lan:14550",
        "udpin::14550",
        "udpin:127.0.0.1:0",
        "udpin:127.0.0.1:65536",
        "tcp:127.0.0.1:1",
        "serial:a:1",
    ],
)
def test_bad_names_are_refused(url):
    with pytest.raises(UsageError, match=f"link '{url}': "):
        open_transport(url, Clock())


@pytest.mark.parametrize("kind", ["udpin", "tcpin"])
def test_a_taken_port_is_refused(kind):
    clock = Clock()
    port = free_port(socket.SOCK_DGRAM if kind == "udpin" else socket.SOCK_STREAM)
    with (
        closing(open_transport(f"{kind}:127.0.0.1:{port}", clock)),
        pytest.raises(UsageError, match="already in use"),
    ):
        open_transport(f"{kind}:127.0.0.1:{port}", clock)


@pytest.fixture
def rc_link():
    """A receiver's port, and a socket that sends to it."""
    port = free_port()
    with closing(RcInput(port)) as rc_input, udp_client() as transmitter:
        transmitter.connect(("127.0.0.1", port))
        yield rc_input, transmitter


@pytest.mark.parametrize("count", [8, 16])
def test_the_newest_8_or_16_receiver_values_count_and_other_sizes_are_ignored(rc_link, count):
    rc_input, transmitter = rc_link
    assert rc_input.latest() is None
    values = tuple(range(1000, 1000 + count))
    for data in (
        struct.pack("<8H", *[1100] * 8),
        struct.pack(f"<{count}H", *values),
        b"",
        b"x" * 31,
    ):
        transmitter.send(data)
    assert rc_input.latest() == values
    assert rc_input.latest() is None


def test_a_taken_receiver_port_is_named(rc_link):
    port = rc_link[1].getpeername()[1]
    with pytest.raises(UsageError, match=f"--rc-in {port}"):
        RcInput(port)
