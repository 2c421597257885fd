"""Bytes in and out of a socket or serial port, never blocking, with the kernel's arrival stamps."""

import errno
import select
import socket
import struct
import sys
import time
from collections.abc import Iterator
from typing import NamedTuple, Protocol, TypeAlias

import serial

from mavbridge.clock import NS_PER_S, Clock
from mavbridge.errors import UserError

Address: TypeAlias = tuple[str, int]

MAX_CHUNKS_PER_DRAIN = 2000
"""Bound of one drain: a flood must not keep the action loop from its next slot."""
_CHUNK_BYTES = 65536
_SO_TIMESTAMPNS = 35
"""asm-generic/socket.h; Python's socket module does not name it."""
_TIMESPEC = struct.Struct("@qq")


class Chunk(NamedTuple):
    """Bytes as they arrived."""

    data: bytes
    arrived_ns: int
    sender: Address | None


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

    def send(self, data: bytes) -> None:
        """Hand one packet to the kernel; dropped while nobody is there to get it."""
        ...

    def close(self) -> None:
        """Give the socket or port back."""
        ...


class UdpTransport:
    """UDP, listening (``udp:``, ``udpin:``) or calling (``udpout:``)."""

    def __init__(self, address: Address, clock: Clock, *, listen: bool) -> None:
        self._address = address
        self._clock = clock
        self._listen = listen
        self._peer: Address | None = None if listen else address
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Bind or prepare the socket."""
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp.setblocking(False)
        if sys.platform == "linux":
            udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            if self._listen:
                udp.bind(self._address)
            self._peer = (
                None if self._listen else (socket.gethostbyname(self._address[0]), self._address[1])
            )
        except OSError as error:
            udp.close()
            host, port = self._address
            hint = (
                "another program listens there: stop it, or choose another port"
                if error.errno == errno.EADDRINUSE
                else "check the address"
            )
            raise UserError(f"cannot use udp {host}:{port}: {error.strerror}; {hint}") from error
        self._socket = udp

    def drain(self) -> Iterator[Chunk]:
        """Datagrams with the kernel's arrival stamp where it gives one."""
        if self._socket is None:
            return
        for _ in range(MAX_CHUNKS_PER_DRAIN):
            try:
                data, control, _, sender = self._socket.recvmsg(_CHUNK_BYTES, 64)
            except BlockingIOError:
                return
            except ConnectionError:
                continue  # an ICMP answer to an earlier send: nobody listens there yet
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

    def send(self, data: bytes) -> None:
        """Send one datagram to the peer, if there is one."""
        if self._socket is None or self._peer is None:
            return
        try:
            self._socket.sendto(data, self._peer)
        except (BlockingIOError, ConnectionError):
            return  # a full buffer or an absent peer loses a datagram, as UDP may
        except OSError as error:
            raise TransportDownError(f"udp: {error.strerror}") from error

    def close(self) -> None:
        """Close the socket."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None


class TcpTransport:
    """TCP client (``tcp:``); connects in the background of ``drain``."""

    def __init__(self, address: Address, clock: Clock) -> None:
        self._address = address
        self._clock = clock
        self._socket: socket.socket | None = None
        self._connected = False
        self._unsent = b""

    def open(self) -> None:
        """Begin to connect; ``drain`` finds out how it went."""
        tcp = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        tcp.setblocking(False)
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        try:
            code = tcp.connect_ex(self._address)
        except OSError as error:
            tcp.close()
            raise UserError(f"cannot resolve {self._address[0]}: {error.strerror}") from error
        if code not in (0, errno.EINPROGRESS, errno.EWOULDBLOCK):
            tcp.close()
            raise TransportDownError(self._explain(code))
        self._socket, self._connected, self._unsent = tcp, False, b""

    def _explain(self, code: int) -> str:
        host, port = self._address
        return f"tcp {host}:{port}: {errno.errorcode.get(code, code)}"

    def drain(self) -> Iterator[Chunk]:
        """Bytes received so far; loss of the connection is an error."""
        for _ in range(MAX_CHUNKS_PER_DRAIN):
            if self._socket is None:
                return
            try:
                data = self._socket.recv(_CHUNK_BYTES)
            except BlockingIOError:
                return
            except OSError as error:
                if not self._connected and error.errno == errno.ENOTCONN:
                    return
                raise TransportDownError(self._explain(error.errno or 0)) from error
            if not data:
                raise TransportDownError("tcp: the vehicle closed the connection")
            self._connected = True
            yield Chunk(data, self._clock.now_ns(), None)

    def wait(self, until_ns: int) -> None:
        """Return when something has arrived, or at the time."""
        _wait_readable(self._socket, self._clock, until_ns)

    def answer_to(self, sender: Address | None) -> None:
        """One connection has one peer."""

    def send(self, data: bytes) -> None:
        """Send; a packet is cut at a full buffer only to be finished first next time."""
        if self._socket is None:
            return
        pending = self._unsent or data
        try:
            sent = self._socket.send(pending)
            if self._unsent:  # the older packet first; the newer one is dropped if that is not all
                self._unsent = pending[sent:]
                if self._unsent:
                    return
                pending, sent = data, self._socket.send(data)
            self._unsent = pending[sent:]
        except BlockingIOError:
            return
        except OSError as error:
            if error.errno in (errno.ENOTCONN, errno.EINPROGRESS):
                return
            raise TransportDownError(self._explain(error.errno or 0)) from error

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

    def open(self) -> None:
        """Open the port for non-blocking use."""
        try:
            self._port = serial.Serial(self._device, self._baud, timeout=0, write_timeout=0)
        except (serial.SerialException, ValueError) as error:
            raise TransportDownError(f"serial {self._device}: {error}") from error

    def drain(self) -> Iterator[Chunk]:
        """Bytes received so far."""
        if self._port is None:
            return
        try:
            data = self._port.read(_CHUNK_BYTES)
        except (serial.SerialException, OSError) as error:
            raise TransportDownError(f"serial {self._device}: {error}") from error
        if data:
            yield Chunk(data, self._clock.now_ns(), None)

    def wait(self, until_ns: int) -> None:
        """Return when something has arrived, or at the time."""
        _wait_readable(self._port, self._clock, until_ns)

    def answer_to(self, sender: Address | None) -> None:
        """One port has one peer."""

    def send(self, data: bytes) -> None:
        """Queue one packet; dropped when the port's buffer is full."""
        if self._port is None:
            return
        try:
            self._port.write(data)
        except serial.SerialTimeoutException:
            return
        except (serial.SerialException, OSError) as error:
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
        UserError: the string is none of them.
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
