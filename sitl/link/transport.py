"""Sockets that carry MAVLink bytes: never blocking, drained until empty, stamped on arrival."""

import errno
import socket
import struct
from collections.abc import Iterator
from contextlib import suppress
from typing import NamedTuple, TypeAlias

from sitl import UsageError
from sitl.clock import NS_PER_S, Clock, monotonic_from_wall_ns

Address: TypeAlias = tuple[str, int]  # IPv4 host and port

VEHICLE_KINDS = ("udpout", "udpin", "tcpin")  # links of a vehicle
FOLLOWER_KINDS = ("udp", "udpin", "udpout", "tcp")  # links to another vehicle; ``udp`` is ``udpin``
MAX_DATAGRAM = 65535
MAX_PEERS = 8  # addresses that a listening link answers; a new one replaces the longest silent
MAX_READS = 1000
"""Reads per drain, so that a flood cannot stop the loop; the rest waits for the next step."""
CONNECT_TIMEOUT_S = 1.0

_SO_TIMESTAMPNS = 35  # Linux (asm-generic/socket.h); not in Python
_TIMESPEC = struct.Struct("@qq")
_ANCILLARY_BYTES = 64


class Received(NamedTuple):
    """One datagram, or one read of a stream, with its arrival."""

    data: bytes
    arrived_ns: int


def open_transport(url: str, clock: Clock, kinds: tuple[str, ...] = VEHICLE_KINDS) -> "Transport":
    """Open a link by its name, KIND:HOST:PORT.

    ``udpout`` sends first; ``udpin`` listens and answers all senders it has heard; ``tcpin`` serves
    clients, together or one after another; ``tcp`` connects at each send without a connection, so
    it recovers a lost one.

    Raises:
        UsageError: the name is malformed, the host is unknown or the port is taken.
    """
    kind, _, rest = url.partition(":")
    host, _, port_text = rest.rpartition(":")
    if kind not in kinds or not host or not port_text.isdecimal():
        wanted = ", ".join(f"{kind}:HOST:PORT" for kind in kinds)
        raise UsageError(f"link {url!r}: expected one of {wanted}")
    port = int(port_text)
    if not 0 < port < 65536:
        raise UsageError(f"link {url!r}: port {port} is not within 1..65535")
    try:
        address = (socket.gethostbyname(host), port)
        if kind.startswith("tcp"):
            return TcpLink(address, clock, listen=kind == "tcpin")
        return UdpLink(address, clock, listen=kind != "udpout")
    except UnicodeError as error:
        raise UsageError(f"link {url!r}: {host!r} is no host's name") from error
    except OSError as error:
        raise UsageError(f"link {url!r}: {_reason(error)}") from error


def _reason(error: OSError) -> str:
    in_use = error.errno == errno.EADDRINUSE
    return "already in use" if in_use else error.strerror or str(error)


class UdpLink:
    """UDP link that either listens or sends to one address."""

    def __init__(self, address: Address, clock: Clock, *, listen: bool) -> None:
        self._clock = clock
        self._listen = listen
        self._peers: list[Address] = [] if listen else [address]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if listen:
                self._socket.bind(address)
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise
        with suppress(OSError):  # without kernel stamps, stamp on reading
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def drain(self) -> Iterator[Received]:
        """Yield all datagrams in the socket's buffer, with the kernel's arrival stamps."""
        for _ in range(MAX_READS):
            try:
                data, ancillary, _, sender = self._socket.recvmsg(MAX_DATAGRAM, _ANCILLARY_BYTES)
            except BlockingIOError:
                return
            except ConnectionError:  # an earlier datagram was rejected
                continue
            if self._listen:
                others = [peer for peer in self._peers if peer != sender]
                self._peers = [*others[-MAX_PEERS + 1 :], sender]
            yield Received(data, self._arrival_ns(ancillary))

    def send(self, data: bytes) -> None:
        """Send one datagram to every peer; drop it where that is not possible now."""
        for peer in self._peers if data else ():
            with suppress(OSError):
                self._socket.sendto(data, peer)

    def close(self) -> None:
        self._socket.close()

    def _arrival_ns(self, ancillary: list[tuple[int, int, bytes]]) -> int:
        for level, kind, payload in ancillary:
            is_stamp = level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS
            if is_stamp and len(payload) >= _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack_from(payload)
                return monotonic_from_wall_ns(seconds * NS_PER_S + nanoseconds)
        return self._clock.now_ns()


class TcpLink:
    """TCP link: a server whose clients share one MAVLink link, or a client that reconnects."""

    def __init__(self, address: Address, clock: Clock, *, listen: bool) -> None:
        self._clock = clock
        self._address = address
        self._connections: list[socket.socket] = []
        self._server = socket.create_server(address) if listen else None
        if self._server is not None:
            self._server.setblocking(False)

    def drain(self) -> Iterator[Received]:
        """Accept waiting clients, then read every connection; drop closed ones."""
        while self._server is not None and len(self._connections) < MAX_PEERS:
            try:
                self._add(self._server.accept()[0])
            except OSError:  # no client waits, or it has left
                break
        for connection in tuple(self._connections):
            try:
                data = connection.recv(MAX_DATAGRAM)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if data:
                yield Received(data, self._clock.now_ns())
            else:
                self._drop(connection)

    def send(self, data: bytes) -> None:
        """Send on every connection; drop a peer that does not read, instead of waiting for it."""
        if not data:
            return
        if self._server is None and not self._connections:
            try:
                self._add(socket.create_connection(self._address, CONNECT_TIMEOUT_S))
            except OSError:
                return
        for connection in tuple(self._connections):
            try:
                is_sent = connection.send(data) == len(data)
            except OSError:
                is_sent = False
            if not is_sent:
                self._drop(connection)

    def close(self) -> None:
        for connection in tuple(self._connections):
            self._drop(connection)
        if self._server is not None:
            self._server.close()

    def _add(self, connection: socket.socket) -> None:
        connection.setblocking(False)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connections.append(connection)

    def _drop(self, connection: socket.socket) -> None:
        self._connections.remove(connection)
        connection.close()


Transport: TypeAlias = UdpLink | TcpLink


HOST = "127.0.0.1"
_LAYOUTS = {layout.size: layout for layout in (struct.Struct("<8H"), struct.Struct("<16H"))}


class RcInput(UdpLink):
    """Local UDP port that takes receiver values, as ArduPilot's SITL does; never blocks.

    A datagram is 8 or 16 little-endian uint16, one PWM value in microseconds per channel. A 0
    leaves its channel unchanged; all zeros switch the transmitter off.

    Raises:
        UsageError: the port is taken.
    """

    def __init__(self, port: int) -> None:
        try:
            super().__init__((HOST, port), Clock(), listen=True)
        except OSError as error:
            raise UsageError(f"--rc-in {port}: {_reason(error)}") from error

    def latest(self) -> tuple[int, ...] | None:
        """Return the newest values since the last call [us]; None if none came.

        Datagrams of any other size are ignored.
        """
        newest = None
        for received in self.drain():
            if layout := _LAYOUTS.get(len(received.data)):
                newest = layout.unpack(received.data)
        return newest
