"""Bytes in and out of a socket or serial port, never blocking, with the kernel's arrival stamps."""

import errno
import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from typing import NamedTuple, Protocol, TypeAlias

import serial

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import UserError

Address: TypeAlias = tuple[str, int]

TCP_SILENCE_NS = 5 * NS_PER_S
"""A vehicle beats at 1 Hz: a connection this quiet is dead, whatever the kernel believes."""
_CHUNK_BYTES = 65536
_SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; Python's socket module does not name it."""
_TIMESPEC = struct.Struct("@qq")


class Chunk(NamedTuple):
    """Bytes as they arrived."""

    data: bytes
    arrived_ns: int
    sender: Address | None
    """Of a datagram; None on a stream, which has one far end."""


class TransportDownError(Exception):
    """The far end or the port is gone; closing and opening again may help."""


class Transport(Protocol):
    """One way to reach a vehicle; used by one thread."""

    def open(self) -> None:
        """Acquire the socket or port.

        Raises:
            UserError: it cannot be had as asked, and trying again will not help.
            TransportDownError: it cannot be had now.
        """
        ...

    def drain(self) -> Iterator[Chunk]:
        """Everything that has arrived. Raises TransportDownError when the link is lost."""
        ...

    def wait(self, until_ns: int) -> None:
        """Return when something can be drained, or at the time."""
        ...

    def answer_to(self, sender: Address | None) -> None:
        """From now on send to this peer (no effect where there is only one)."""
        ...

    def send(self, data: bytes) -> bool:
        """Hand one packet to the kernel, whole; False: dropped, since it cannot go now.

        Raises:
            TransportDownError: the link is lost.
        """
        ...

    def close(self) -> None:
        """Give the socket or port back."""
        ...


def _wait_readable(
    source: socket.socket | serial.Serial | None, clock: Clock, until_ns: int
) -> None:
    timeout_ns = until_ns - clock.now_ns()
    if timeout_ns <= 0:
        return
    if source is None:
        clock.sleep_until_ns(until_ns)
        return
    select.select([source], [], [], timeout_ns / NS_PER_S)


def _resolve(address: Address) -> Address:
    """Once, at the start: a resolver may block, and must not do so in flight."""
    host, port = address
    try:
        return socket.gethostbyname(host), port
    except OSError as error:
        raise UserError(f"cannot find host {host!r}: {error.strerror}") from error


class UdpTransport:
    """UDP, listening (``udp:``, ``udpin:``) or calling (``udpout:``)."""

    def __init__(self, address: Address, clock: Clock, *, listen: bool) -> None:
        self._address = _resolve(address)
        self._clock = clock
        self._listen = listen
        self._peer: Address | None = None if listen else self._address
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Bind or prepare the socket."""
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp.setblocking(False)
        if sys.platform == "linux":
            udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        if self._listen:
            self._bind(udp)
        self._socket = udp

    def _bind(self, udp: socket.socket) -> None:
        try:
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

    def drain(self) -> Iterator[Chunk]:
        """Datagrams with the kernel's arrival stamp where it gives one."""
        while self._socket is not None:
            try:
                data, control, _, sender = self._socket.recvmsg(_CHUNK_BYTES, 64)
            except BlockingIOError:
                return
            except OSError:
                continue  # the network's answer to an earlier send: nobody is there yet
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

    def wait(self, until_ns: int) -> None:
        """Return when something has arrived, or at the time."""
        _wait_readable(self._socket, self._clock, until_ns)

    def answer_to(self, sender: Address | None) -> None:
        """Send to this peer from now on, if we listen."""
        if self._listen:
            self._peer = sender

    def send(self, data: bytes) -> bool:
        """Send one datagram to the peer, if there is one and it can be reached now."""
        if self._socket is None or self._peer is None:
            return False
        try:
            self._socket.sendto(data, self._peer)
        except OSError:
            return False  # full buffer, no route, nobody there: UDP loses a datagram and goes on
        return True

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class _Outbox:
    """Whole packets into a stream that may take a part: the rest of one goes before the next."""

    def __init__(self) -> None:
        self._rest = b""

    def put(self, data: bytes, write: Callable[[bytes], int]) -> bool:
        """Write the packet, or drop it whole; raises what ``write`` raises."""
        try:
            if self._rest:
                self._rest = self._rest[write(self._rest) :]
                if self._rest:
                    return False
            self._rest = data[write(data) :]
        except BlockingIOError:
            return False
        return True


class TcpTransport:
    """TCP client (``tcp:``); connects in the background of ``drain``."""

    def __init__(self, address: Address, clock: Clock) -> None:
        self._address = _resolve(address)
        self._clock = clock
        self._socket: socket.socket | None = None
        self._is_connected = False
        self._heard_ns = 0
        self._outbox = _Outbox()

    def open(self) -> None:
        """Begin to connect; ``drain`` finds out how it went."""
        tcp = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        tcp.setblocking(False)
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            code = tcp.connect_ex(self._address)
        except OSError as error:
            code = error.errno or errno.EIO
        if code not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
            tcp.close()
            raise TransportDownError(self._explain(code))
        self._socket, self._is_connected, self._outbox = tcp, False, _Outbox()
        self._heard_ns = self._clock.now_ns()

    def _explain(self, code: int | None) -> str:
        host, port = self._address
        return f"tcp {host}:{port}: {errno.errorcode.get(code or 0, code)}"

    def drain(self) -> Iterator[Chunk]:
        """Bytes received so far; loss of the connection, or of the far end, is an error."""
        while self._socket is not None:
            try:
                data = self._socket.recv(_CHUNK_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                if not self._is_connected and error.errno == errno.ENOTCONN:
                    break
                raise TransportDownError(self._explain(error.errno)) from error
            if not data:
                raise TransportDownError("tcp: the vehicle closed the connection")
            self._is_connected = True
            self._heard_ns = self._clock.now_ns()
            yield Chunk(data, self._heard_ns, None)
        if self._socket is not None and self._clock.now_ns() - self._heard_ns > TCP_SILENCE_NS:
            raise TransportDownError(f"tcp: silent for {TCP_SILENCE_NS // NS_PER_S} s")

    def wait(self, until_ns: int) -> None:
        """Return when something has arrived, or at the time."""
        _wait_readable(self._socket, self._clock, until_ns)

    def answer_to(self, sender: Address | None) -> None:
        """One connection has one peer."""

    def send(self, data: bytes) -> bool:
        """Send one packet whole."""
        if self._socket is None:
            return False
        try:
            return self._outbox.put(data, self._socket.send)
        except OSError as error:
            if error.errno in (errno.ENOTCONN, errno.EINPROGRESS):
                return False
            raise TransportDownError(self._explain(error.errno)) from error

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class SerialTransport:
    """A serial port (``/dev/ttyX,BAUD``)."""

    def __init__(self, device: str, baud: int, clock: Clock) -> None:
        self._device = device
        self._baud = baud
        self._clock = clock
        self._port: serial.Serial | None = None
        self._was_open = False
        self._outbox = _Outbox()

    def open(self) -> None:
        """Open the port for non-blocking use, and for nobody else."""
        try:
            self._port = serial.Serial(self._device, self._baud, timeout=0, exclusive=True)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            if self._was_open:
                raise TransportDownError(f"serial {self._device}: {error}") from error
            raise UserError(
                f"cannot open {self._device} at {self._baud} baud: {error}; check the name, that "
                "no other program uses it, and that you may (group dialout)"
            ) from error
        self._was_open = True
        self._outbox = _Outbox()

    def drain(self) -> Iterator[Chunk]:
        """Bytes received so far."""
        if self._port is None:
            return
        try:
            data = self._port.read(_CHUNK_BYTES)
        except OSError as error:
            raise TransportDownError(f"serial {self._device}: {error}") from error
        if data:
            yield Chunk(data, self._clock.now_ns(), None)

    def wait(self, until_ns: int) -> None:
        """Return when something has arrived, or at the time."""
        _wait_readable(self._port, self._clock, until_ns)

    def answer_to(self, sender: Address | None) -> None:
        """One port has one peer."""

    def send(self, data: bytes) -> bool:
        """Queue one packet whole.

        Past pyserial, whose write spins without end on a full buffer.
        """
        if self._port is None:
            return False
        descriptor = self._port.fileno()
        try:
            return self._outbox.put(data, lambda part: os.write(descriptor, part))
        except OSError as error:
            raise TransportDownError(f"serial {self._device}: {error}") from error

    def close(self) -> None:
        """Close the port."""
        if self._port is not None:
            self._port.close()
            self._port = None


_FORMS = "udp:HOST:PORT, udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or /dev/ttyX,BAUD"


def make_transport(spec: str, clock: Clock) -> Transport:
    """The transport that a connection string asks for (pymavlink's forms), not opened yet.

    Raises:
        UserError: the string is none of them, or names a host that does not exist.
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
    return host, int(port)
