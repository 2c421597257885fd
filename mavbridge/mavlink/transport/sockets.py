"""Bytes in and out of a socket or serial port, never blocking, with the kernel's arrival stamps."""

import errno
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from typing import Generic, NamedTuple, Protocol, TypeAlias, TypeVar

import serial

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import UserError

Address: TypeAlias = tuple[str, int]

TCP_SILENCE_NS = 5 * NS_PER_S
"""Heartbeats come at 1 Hz: a connection this quiet is dead, even if the kernel has not noticed."""
_CHUNK_BYTES = 65536
_SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; Python's socket module does not name it."""
_TIMESPEC = struct.Struct("@qq")


class Chunk(NamedTuple):
    """Bytes as they arrived."""

    data: bytes
    arrived_ns: int
    sender: Address | None
    """Source of a datagram; None on a stream, which has a single peer."""


class TransportDownError(Exception):
    """The peer or the port is gone; closing and opening again may help."""


class Transport(Protocol):
    """A non-blocking connection to a vehicle; used by one thread."""

    def open(self) -> None:
        """Acquire the socket or port.

        Raises:
            UserError: it cannot be opened as configured, and trying again will not help.
            TransportDownError: it cannot be opened now.
        """

    def drain(self) -> Iterator[Chunk]:
        """Everything that has arrived. Raises TransportDownError when the connection is lost."""

    def wait(self, until_ns: int) -> None:
        """Return when ``drain`` has something to yield, or at the given time."""

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """Hand one whole packet to the kernel; False: dropped, because it cannot be sent now.

        ``peer`` is the receiver of a datagram where we listen; nothing else heeds it. Raises
        TransportDownError when the connection is lost.
        """

    def close(self) -> None:
        """Free the socket or port; may be called twice."""


_Handle = TypeVar("_Handle", socket.socket, serial.Serial)


class _Base(Generic[_Handle]):
    """The parts that all transports have in common."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._handle: _Handle | None = None

    def wait(self, until_ns: int) -> None:
        """See `Transport`."""
        timeout_ns = until_ns - self._clock.now_ns()
        if self._handle is None:
            self._clock.sleep_until_ns(until_ns)
        elif timeout_ns > 0:
            select.select([self._handle], [], [], timeout_ns / NS_PER_S)

    def close(self) -> None:
        """See `Transport`."""
        if self._handle is not None:
            self._handle.close()
            self._handle = None


class UdpTransport(_Base[socket.socket]):
    """UDP, listening (``udp:``, ``udpin:``) or calling (``udpout:``)."""

    def __init__(self, address: Address, clock: Clock, *, listen: bool) -> None:
        super().__init__(clock)
        self._address = address
        self._listen = listen

    def open(self) -> None:
        """See `Transport`."""
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp.setblocking(False)
        if sys.platform == "linux":
            udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            if self._listen:
                udp.bind(self._address)
        except OSError as error:
            udp.close()
            host, port = self._address
            hint = (
                "another program listens there: stop it, or choose another port"
                if error.errno == errno.EADDRINUSE
                else "check the address"
            )
            raise UserError(f"cannot use udp {host}:{port}: {error.strerror}; {hint}") from error
        self._handle = udp

    def drain(self) -> Iterator[Chunk]:
        """Datagrams, with the kernel's arrival stamp where there is one."""
        while self._handle is not None:
            try:
                data, control, _, sender = self._handle.recvmsg(_CHUNK_BYTES, 64)
            except BlockingIOError:
                return
            except OSError:
                continue  # the network's answer to an earlier send: nobody listens there yet
            yield Chunk(data, self._arrival_ns(control), sender)

    def _arrival_ns(self, control: list[tuple[int, int, bytes]]) -> int:
        now_ns = self._clock.now_ns()
        for level, kind, payload in control:
            if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack(payload[: _TIMESPEC.size])
                # The stamp is wall time: only its distance from now is used.
                stamp_ns: int = seconds * NS_PER_S + nanoseconds
                queued_ns = time.clock_gettime_ns(time.CLOCK_REALTIME) - stamp_ns
                return now_ns - min(max(queued_ns, 0), NS_PER_S)
        return now_ns

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """Send one datagram to the peer, if there is one and it can be reached now."""
        receiver = peer if self._listen else self._address
        if self._handle is None or receiver is None:
            return False
        try:
            self._handle.sendto(data, receiver)
        except OSError:
            return False  # full buffer, no route, nobody listens: this datagram is lost, no more
        return True


class _StreamTransport(_Base[_Handle]):
    """A stream that may take a part of a packet: the rest goes out before the next packet."""

    _unsent = b""

    def _put(self, data: bytes, write: Callable[[bytes], int]) -> bool:
        """Write the packet, or drop it whole; raises OSError as ``write`` does."""
        try:
            if self._unsent:
                self._unsent = self._unsent[write(self._unsent) :]
                if self._unsent:
                    return False
            self._unsent = data[write(data) :]
        except BlockingIOError:
            return False
        return True


class TcpTransport(_StreamTransport[socket.socket]):
    """TCP client (``tcp:``)."""

    def __init__(self, address: Address, clock: Clock) -> None:
        super().__init__(clock)
        self._address = address
        self._is_connected = False
        self._heard_ns = 0

    def open(self) -> None:
        """Begin to connect; ``drain`` finds out whether it succeeded."""
        tcp = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        tcp.setblocking(False)
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            code = tcp.connect_ex(self._address)
        except OSError as error:
            code = error.errno or errno.EIO
        if code not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
            tcp.close()
            raise self._down(code)
        self._handle, self._is_connected, self._unsent = tcp, False, b""
        self._heard_ns = self._clock.now_ns()

    def _down(self, code: int | None) -> TransportDownError:
        host, port = self._address
        return TransportDownError(f"tcp {host}:{port}: {errno.errorcode.get(code or 0, code)}")

    def drain(self) -> Iterator[Chunk]:
        """Bytes received so far."""
        while self._handle is not None:
            try:
                data = self._handle.recv(_CHUNK_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                if not self._is_connected and error.errno == errno.ENOTCONN:
                    break
                raise self._down(error.errno) from error
            if not data:
                raise TransportDownError("tcp: the vehicle closed the connection")
            self._is_connected = True
            self._heard_ns = self._clock.now_ns()
            yield Chunk(data, self._heard_ns, None)
        if self._handle is not None and self._clock.now_ns() - self._heard_ns > TCP_SILENCE_NS:
            raise TransportDownError(f"tcp: silent for {TCP_SILENCE_NS // NS_PER_S} s")

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """See `Transport`."""
        if self._handle is None:
            return False
        try:
            return self._put(data, self._handle.send)
        except OSError as error:
            if error.errno in (errno.ENOTCONN, errno.EINPROGRESS):
                return False
            raise self._down(error.errno) from error


class SerialTransport(_StreamTransport[serial.Serial]):
    """A serial port (``/dev/ttyX,BAUD``)."""

    def __init__(self, device: str, baud: int, clock: Clock) -> None:
        super().__init__(clock)
        self._device = device
        self._baud = baud
        self._was_open = False

    def open(self) -> None:
        """Open the port, non-blocking and exclusive."""
        try:
            self._handle = serial.Serial(self._device, self._baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            if self._was_open:
                raise self._down(error) from error
            raise UserError(
                f"cannot open {self._device} at {self._baud} baud: {error}; check the name, that "
                "no other program uses it, and that you have permission (group dialout)"
            ) from error
        self._was_open = True
        self._unsent = b""

    def _down(self, error: Exception) -> TransportDownError:
        return TransportDownError(f"serial {self._device}: {error}")

    def drain(self) -> Iterator[Chunk]:
        """Bytes received so far."""
        if self._handle is None:
            return
        try:
            data = self._handle.read(_CHUNK_BYTES)
        except OSError as error:
            raise self._down(error) from error
        if data:
            yield Chunk(data, self._clock.now_ns(), None)

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """See `Transport`. Bypasses pyserial, whose write loops forever on a full buffer."""
        if self._handle is None:
            return False
        descriptor = self._handle.fileno()
        try:
            return self._put(data, lambda part: os.write(descriptor, part))
        except OSError as error:
            raise self._down(error) from error


_FORMS = "udp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/ttyX,BAUD"


def make_transport(spec: str, clock: Clock) -> Transport:
    """The transport for a connection string in pymavlink's notation, not opened yet.

    Raises UserError if the string is malformed, or its host does not exist.
    """
    kind, _, rest = spec.partition(":")
    if kind in ("udp", "udpin", "udpout"):
        return UdpTransport(_address(spec, rest), clock, listen=kind != "udpout")
    if kind == "tcp":
        return TcpTransport(_address(spec, rest), clock)
    if spec.startswith(("/dev/", "COM")):
        device, _, baud = spec.partition(",")
        if baud and not baud.isdigit():
            raise UserError(f"--connect {spec}: {baud!r} is not a baud rate; use {_FORMS}")
        return SerialTransport(device, int(baud or 57600), clock)
    if spec.count(":") == 1:  # a bare HOST:PORT listens, as in pymavlink
        return UdpTransport(_address(spec, spec), clock, listen=True)
    raise UserError(f"--connect {spec!r} is not understood; use {_FORMS}")


def _address(spec: str, text: str) -> Address:
    host, _, port = text.rpartition(":")
    if not (host and port.isdigit() and 0 < int(port) < 65536):
        raise UserError(f"--connect {spec!r}: {text!r} is not HOST:PORT; use {_FORMS}")
    try:
        return socket.gethostbyname(host), int(port)  # now: a resolver may block
    except OSError as error:
        raise UserError(f"cannot find host {host!r}: {error.strerror}") from error
