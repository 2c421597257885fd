"""Sockets that carry MAVLink bytes: never blocking, drained until empty, stamped on arrival.

A link is named ``udpout:HOST:PORT`` (sends there first), ``udpin:HOST:PORT`` (listens, answers
everybody it has heard) or ``tcpin:HOST:PORT`` (serves clients, at once or one after another).
"""

import errno
import socket
import struct
from collections.abc import Iterator
from typing import NamedTuple, Protocol

from sitl.clock import NS_PER_S, Clock, monotonic_from_wall_ns
from sitl.errors import UsageError

MAX_DATAGRAM = 65535
MAX_PACKED = 1200
"""Frames of one step share a datagram up to this size: below any usual MTU."""
MAX_PEERS = 8
"""Addresses that a listening link answers; the one that was silent longest makes room."""
READS_PER_DRAIN = 1000
"""A flood cannot keep the vehicle from flying: the rest waits for the next step."""

_SO_TIMESTAMPNS = 35
"""Linux (asm-generic/socket.h); Python does not name it."""
_TIMESPEC = struct.Struct("@qq")
_ANCILLARY_BYTES = 64
_V1_MAGIC, _V1_OVERHEAD = 0xFE, 8
_V2_OVERHEAD, _SIGNATURE, _SIGNED_FLAG = 12, 13, 0x01


class Received(NamedTuple):
    """Bytes as they came: one datagram, or one read of a stream."""

    data: bytes
    arrived_ns: int


class Transport(Protocol):
    """One MAVLink link's way to the outside."""

    def drain(self) -> Iterator[Received]:
        """All that has arrived since the last call."""
        ...

    def send(self, data: bytes) -> None:
        """Send whole frames; what cannot be sent now is dropped, as on any datagram link."""
        ...

    def close(self) -> None:
        """Free the port."""
        ...


def open_transport(url: str, clock: Clock) -> Transport:
    """Open a link by its name.

    Raises:
        UsageError: the name is malformed, the host is unknown or the port is taken.
    """
    kind, _, rest = url.partition(":")
    host, _, port_text = rest.rpartition(":")
    if kind not in ("udpout", "udpin", "tcpin") or not host or not port_text.isdecimal():
        raise UsageError(
            f"--connect {url}: expected udpout:HOST:PORT, udpin:HOST:PORT or tcpin:HOST:PORT"
        )
    port = int(port_text)
    if not 0 < port < 65536:
        raise UsageError(f"--connect {url}: port {port} is not within 1..65535")
    try:
        address = (socket.gethostbyname(host), port)
        if kind == "tcpin":
            return TcpServer(address, clock)
        return UdpLink(address, clock, listen=kind == "udpin")
    except OSError as error:
        reason = "already in use" if error.errno == errno.EADDRINUSE else error.strerror or error
        raise UsageError(f"--connect {url}: {reason}") from error


class UdpLink:
    """UDP in either role."""

    def __init__(self, address: tuple[str, int], clock: Clock, *, listen: bool) -> None:
        self._clock = clock
        self._listen = listen
        self._peers: list[tuple[str, int]] = [] if listen else [address]
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            if listen:
                self._socket.bind(address)
            self._socket.setblocking(False)
            self._stamped = _ask_for_stamps(self._socket)
        except OSError:
            self._socket.close()
            raise

    def drain(self) -> Iterator[Received]:
        """All datagrams in the socket's buffer, with the kernel's arrival stamps."""
        for _ in range(READS_PER_DRAIN):
            try:
                data, ancillary, _, sender = self._socket.recvmsg(MAX_DATAGRAM, _ANCILLARY_BYTES)
            except BlockingIOError:
                return
            except ConnectionError:  # an earlier datagram found nobody there
                continue
            if self._listen:
                self._remember(sender)
            yield Received(data, self._arrival_ns(ancillary))

    def send(self, data: bytes) -> None:
        """Send to every peer."""
        for datagram in split_frames(data, MAX_PACKED):
            for peer in self._peers:
                try:
                    self._socket.sendto(datagram, peer)
                except (BlockingIOError, ConnectionError):
                    continue
                except OSError as error:
                    if error.errno not in (errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENOBUFS):
                        raise

    def close(self) -> None:
        """Free the port."""
        self._socket.close()

    def _remember(self, sender: tuple[str, int]) -> None:
        if self._peers and self._peers[-1] == sender:
            return
        if sender in self._peers:
            self._peers.remove(sender)
        self._peers = [*self._peers[-MAX_PEERS + 1 :], sender]

    def _arrival_ns(self, ancillary: list[tuple[int, int, bytes]]) -> int:
        for level, kind, payload in ancillary:
            stamped = level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS
            if self._stamped and stamped and len(payload) >= _TIMESPEC.size:
                seconds, nanoseconds = _TIMESPEC.unpack_from(payload)
                return monotonic_from_wall_ns(seconds * NS_PER_S + nanoseconds)
        return self._clock.now_ns()


class TcpServer:
    """A listening port; clients come and go, and all of them are one MAVLink link."""

    def __init__(self, address: tuple[str, int], clock: Clock) -> None:
        self._clock = clock
        self._clients: list[socket.socket] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            self._socket.bind(address)
            self._socket.listen()
            self._socket.setblocking(False)
        except OSError:
            self._socket.close()
            raise

    def drain(self) -> Iterator[Received]:
        """Accept who waits, then read every client; one that hung up is forgotten."""
        self._accept()
        for client in tuple(self._clients):
            try:
                data = client.recv(MAX_DATAGRAM)
            except BlockingIOError:
                continue
            except OSError:
                data = b""
            if data:
                yield Received(data, self._clock.now_ns())
            else:
                self._drop(client)

    def send(self, data: bytes) -> None:
        """Send to every client; one that does not read is cut off rather than waited for."""
        if not data:
            return
        for client in tuple(self._clients):
            try:
                complete = client.send(data) == len(data)
            except OSError:
                complete = False
            if not complete:
                self._drop(client)

    def close(self) -> None:
        """Hang up on everybody and free the port."""
        for client in tuple(self._clients):
            self._drop(client)
        self._socket.close()

    def _accept(self) -> None:
        while len(self._clients) < MAX_PEERS:
            try:
                client, _ = self._socket.accept()
            except OSError:  # nobody waits, or who waited has gone
                return
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients.append(client)

    def _drop(self, client: socket.socket) -> None:
        self._clients.remove(client)
        client.close()


def _ask_for_stamps(sock: socket.socket) -> bool:
    """Have the kernel stamp datagrams on arrival; False where it cannot."""
    try:
        sock.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
    except OSError:
        return False
    return True


def split_frames(data: bytes, limit: int) -> Iterator[bytes]:
    """Cut whole MAVLink frames into pieces of at most ``limit`` bytes (or one frame, if longer)."""
    start = end = 0
    while end < len(data):
        length = _frame_length(data, end)
        if end > start and end + length - start > limit:
            yield data[start:end]
            start = end
        end += length
    if start < len(data):
        yield data[start:]


def _frame_length(data: bytes, at: int) -> int:
    payload = data[at + 1]
    if data[at] == _V1_MAGIC:
        return payload + _V1_OVERHEAD
    signed = data[at + 2] & _SIGNED_FLAG
    return payload + _V2_OVERHEAD + (_SIGNATURE if signed else 0)
