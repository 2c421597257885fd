"""Non-blocking sockets and serial ports, with the kernel's arrival stamps."""

import contextlib
import errno
import fcntl
import os
import select
import socket
import struct
import sys
import termios
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Generic, TypeVar

import serial
from serial.tools import list_ports

from mavbridge.core.address import (
    SerialAddress,
    TcpAddress,
    UdpAddress,
    family,
    parse_address,
    resolve,
    spelled,
)
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import PeerError, UserError
from mavbridge.mavlink.transport.connection import (
    Address,
    Received,
    Transport,
    TransportDownError,
)

TCP_SILENCE_NS = 5 * NS_PER_S
"""Silence that means a dead connection, known to the kernel or not: heartbeats come at 1 Hz."""
TCP_FIRST_S = 3.0
"""Longest wait for the answer to the first connection attempt, during which nothing else waits."""
STALE_NS = 100 * NS_PER_MS
"""Longest time for a byte in a serial port's queue: the usual age limit of a state."""
_TCP_STALE_MS = 500
"""Longest time for which sent bytes may stay unacknowledged on TCP. Then the connection closes, and
discards the sticks queued in the kernel. Equal to the detection time of unheard sticks."""
_CHUNK_BYTES = 65536
_STREAM_BYTES = 2048
"""Bytes read from a TCP stream at once: some fifty packets, after which a reader may stop."""
_ERRORS_A_DRAIN = 16
"""Errors of earlier sends that one drain skips."""
_SERIAL_BITS = 10
"""Bits per byte on the wire: 8 data bits, a start and a stop bit."""
_STAMP_STEP_NS = 2 * NS_PER_MS
"""A serial backlog that took longer than this to arrive gets several stamps."""
_SO_TIMESTAMPNS = 35
"""From asm-generic/socket.h; Python's socket module lacks it."""
_TIMESPEC = struct.Struct("@qq")
_HOLDER = "stop the program that has it, or wait if that is a guard still giving sticks back"


_Handle = TypeVar("_Handle", socket.socket, serial.Serial)


class _FileTransport(Transport, Generic[_Handle]):
    """Socket or port. A stream may accept part of a packet: the rest precedes the next one."""

    def __init__(self, place: str, clock: Clock) -> None:
        self._place = place
        """Kind and address, for messages."""
        self._clock = clock
        self._handle: _Handle | None = None
        self._unsent = b""
        self._was_open = False

    def _down(self, why: Exception | str) -> TransportDownError:
        if isinstance(why, termios.error):  # no OSError, but with its arguments
            why = OSError(*why.args)
        reason = getattr(why, "strerror", None) or why
        return TransportDownError(f"{self._place}: {reason}")

    def fileno(self) -> int | None:
        """See `Transport`."""
        return None if self._handle is None else self._handle.fileno()

    def close(self) -> None:
        """See `Transport`. Ends the connection first: the flight process may have it open too."""
        if self._handle is not None:
            with contextlib.suppress(OSError):  # the port may be gone already
                self._end(self._handle)
            with contextlib.suppress(OSError):
                self._handle.close()
            self._handle, self._unsent = None, b""

    def _end(self, handle: _Handle) -> None:
        """End what outlives ``close`` while another process has the file open."""

    def _put(self, data: bytes, write: Callable[[bytes], int]) -> bool:
        """Write the packet, or drop it whole; raise OSError as ``write`` does."""
        try:
            if self._unsent:
                self._unsent = self._unsent[write(self._unsent) :]
                if self._unsent:
                    return False
            self._unsent = data[write(data) :]
        except BlockingIOError:
            return False
        return True


class UdpTransport(_FileTransport[socket.socket]):
    """UDP, listening (``udp:``, ``udpin:``) or calling (``udpout:``)."""

    def __init__(self, address: Address, clock: Clock, *, listen: bool) -> None:
        super().__init__(f"udp {spelled(*address)}", clock)
        self._address, self._listen = address, listen

    def open(self) -> None:
        """See `Transport`."""
        udp = new_socket(self._address, socket.SOCK_DGRAM)
        if sys.platform == "linux":
            with contextlib.suppress(OSError):  # emulators of Linux lack it: stamped when read
                udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            if self._listen:
                udp.bind(self._address)
        except OSError as error:
            udp.close()
            hint = {
                errno.EADDRINUSE: f"{_HOLDER} (ss -ulpn names it), or choose another port",
                errno.EADDRNOTAVAIL: "not of this computer; "
                f"udpout:{spelled(*self._address)} sends there",
            }.get(error.errno or 0, "check the address")
            raise UserError(f"cannot use {self._place}: {error.strerror}; {hint}") from error
        self._handle = udp

    def drain(self) -> Iterator[Received]:
        """Yield datagrams, with the kernel's arrival stamp if there is one."""
        errors = 0
        while self._handle is not None and errors < _ERRORS_A_DRAIN:
            try:
                data, control, _, sender = self._handle.recvmsg(_CHUNK_BYTES, 64)
            except BlockingIOError:
                return
            except OSError:
                errors += 1  # answer to an earlier send: nothing listens there yet
                continue
            yield Received(data, self._arrival_ns(control), sender)

    def _arrival_ns(self, control: list[tuple[int, int, bytes]]) -> int:
        now_ns = self._clock.now_ns()
        for level, kind, payload in control:
            if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS:
                seconds, nanoseconds = _TIMESPEC.unpack(payload[: _TIMESPEC.size])
                # The stamp is wall time: use only its distance from now.
                stamp_ns: int = seconds * NS_PER_S + nanoseconds
                queued_ns = time.clock_gettime_ns(time.CLOCK_REALTIME) - stamp_ns
                return now_ns - min(max(queued_ns, 0), NS_PER_S)
        return now_ns

    def receiver(self, peer: Address | None) -> Address | None:
        """See `Transport`."""
        return peer if self._listen else self._address

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """Send one datagram to the peer, if there is one and it is reachable now."""
        receiver, self.refusal = self.receiver(peer), ""
        if self._handle is not None and receiver is not None:
            try:
                self._handle.sendto(data, receiver)
                return True
            except OSError as error:  # full buffer, no route, no listener
                self.refusal = error.strerror or ""
        return False


class TcpTransport(_FileTransport[socket.socket]):
    """TCP client (``tcp:``)."""

    def __init__(self, address: Address, clock: Clock) -> None:
        super().__init__(f"tcp {spelled(*address)}", clock)
        self._address = address
        self._is_connected, self._heard_ns = False, 0

    def open(self) -> None:
        """Connect. The first time, wait for the answer; later, ``drain`` detects it.

        Raise PeerError if the first attempt gets no answer.
        """
        tcp = new_socket(self._address, socket.SOCK_STREAM)
        tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        tcp.settimeout(0.0 if self._was_open else TCP_FIRST_S)
        try:
            tcp.connect(self._address)
        except BlockingIOError:
            pass
        except OSError as error:
            tcp.close()
            if self._was_open:
                raise self._down(error) from error
            reason = f"{error.strerror or error}: check the address and the network"
            if error.errno == errno.ECONNREFUSED:
                reason = "nobody listens there: start the vehicle's end first, or check the port"
            raise PeerError(f"cannot connect to {self._place}: {reason}") from error
        tcp.setblocking(False)
        self._handle, self._is_connected, self._was_open = tcp, False, True
        self._heard_ns = self._clock.now_ns()

    def _end(self, handle: socket.socket) -> None:
        handle.shutdown(socket.SHUT_RDWR)

    def drain(self) -> Iterator[Received]:
        """Yield the bytes received so far."""
        while self._handle is not None:
            try:
                data = self._handle.recv(_STREAM_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                if not self._is_connected and error.errno == errno.ENOTCONN:
                    break
                raise self._down(error) from error
            if not data:
                raise self._down("the vehicle closed the connection")
            if not self._is_connected and sys.platform == "linux":
                option = socket.TCP_USER_TIMEOUT
                self._handle.setsockopt(socket.IPPROTO_TCP, option, _TCP_STALE_MS)
            self._is_connected = True
            self._heard_ns = self._clock.now_ns()
            yield Received(data, self._heard_ns, None)
        if self._handle is not None and self._clock.now_ns() - self._heard_ns > TCP_SILENCE_NS:
            silence = self._down(f"silent for {TCP_SILENCE_NS // NS_PER_S} s")
            silence.is_silence = True
            raise silence

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """See `Transport`."""
        if self._handle is None:
            return False
        try:
            return self._put(data, self._handle.send)
        except OSError as error:
            if error.errno in (errno.ENOTCONN, errno.EINPROGRESS):
                return False
            raise self._down(error) from error


class SerialTransport(_FileTransport[serial.Serial]):
    """A serial port (``/dev/ttyX,BAUD``)."""

    def __init__(self, device: str, baud: int, clock: Clock) -> None:
        super().__init__(f"serial {device}", clock)
        self._device, self._baud = device, baud
        self._backlog: deque[Received] = deque()
        """Bytes read but not yet drained."""
        self._emptied_ns = 0
        """Last time at which the port was seen empty: later bytes arrived later."""
        self._written: deque[tuple[int, int]] = deque()
        """Size and time of the writes that may still wait in the port's queue."""

    def open(self) -> None:
        """Open the port, non-blocking and exclusive."""
        try:
            self._handle = serial.Serial(self._device, self._baud, timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:  # SerialException is an OSError
            if self._was_open:
                raise self._down(error) from error
            raise UserError(
                f"cannot open {self._device} at {self._baud} baud: "
                f"{_serial_obstacle(self._device, error)}"
            ) from error
        self._was_open = True
        self._backlog.clear()
        self._written.clear()
        self._emptied_ns = self._clock.now_ns()

    def _end(self, handle: serial.Serial) -> None:
        fcntl.flock(handle.fileno(), fcntl.LOCK_UN)  # the lock of ``exclusive``

    def drain(self) -> Iterator[Received]:
        """Yield the bytes received so far, in pieces stamped with their time on the wire."""
        if not self._backlog:
            self._read()
        while self._backlog:
            yield self._backlog.popleft()

    def _read(self) -> None:
        """Read everything. The last byte arrived now, each earlier one a byte time before the next.

        Bypasses pyserial, which reads no more than the kernel's line buffer of 4,095 bytes.
        """
        data = b""
        while self._handle is not None and len(data) < _CHUNK_BYTES:
            try:
                if not select.select([self._handle], [], [], 0)[0]:
                    break
                piece = os.read(self._handle.fileno(), _CHUNK_BYTES)
            except BlockingIOError:
                break
            except OSError as error:
                raise self._down(error) from error
            if not piece:
                raise self._down("the device is gone")
            data += piece
        now_ns, byte_ns = self._clock.now_ns(), _SERIAL_BITS * NS_PER_S // self._baud
        step = max(1, _STAMP_STEP_NS // byte_ns)
        for at in range(0, len(data), step):
            piece = data[at : at + step]
            after_ns = (len(data) - at - len(piece)) * byte_ns
            self._backlog.append(Received(piece, max(now_ns - after_ns, self._emptied_ns), None))
        if len(data) < _CHUNK_BYTES:
            self._emptied_ns = now_ns

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """See `Transport`. Bypasses pyserial, whose write loops forever on a full buffer."""
        if self._handle is None:
            return False
        try:
            self._drop_stale(self._handle)
            return self._put(data, self._write)
        except (OSError, termios.error) as error:
            raise self._down(error) from error

    def _write(self, part: bytes) -> int:
        assert self._handle is not None
        size = os.write(self._handle.fileno(), part)
        self._written.append((size, self._clock.now_ns()))
        return size

    def _drop_stale(self, port: serial.Serial) -> None:
        """Empty the port's queue if its oldest byte is stale.

        No one reads it now, and sticks that old must not act later. A packet may be cut; its
        checksum shows it.

        Drivers that do not report their queue, such as pseudo-terminals, keep it.
        """
        waiting = port.out_waiting
        extra = sum(size for size, _ in self._written) - waiting
        while self._written and self._written[0][0] <= extra:
            extra -= self._written.popleft()[0]
        if self._written and waiting and self._clock.now_ns() - self._written[0][1] > STALE_NS:
            port.reset_output_buffer()
            self._written.clear()
            self._unsent = b""


def _serial_obstacle(device: str, error: Exception) -> str:
    """Return the obstacle to opening a serial port, with advice."""
    if isinstance(error, FileNotFoundError) or not Path(device).exists():
        names = ", ".join(sorted(info.device for info in list_ports.comports()))
        here = f"present: {names}" if names else "this computer has none: is it plugged in?"
        return f"there is no such port; {here}"
    text, code = str(error), getattr(error, "errno", None)
    if code == errno.EACCES:
        return "no permission: join its group (sudo usermod -aG dialout $USER, then log in anew)"
    if code in (errno.ENOTTY, errno.EISDIR) or "ioctl" in text:  # pyserial may hide the number
        return "it is no serial port"
    if code in (errno.EBUSY, errno.EAGAIN) or "exclusively lock" in text:
        return f"it is in use; {_HOLDER} (fuser {device} names it)"
    return text


def make_transport(spec: str, clock: Clock) -> Transport:
    """Return an unopened transport for an address in the syntax of ``address.parse_address``.

    Raise UserError if the address is malformed, or its host does not exist.
    """
    match parse_address(spec):
        case UdpAddress(host, port, listens):
            return UdpTransport(resolve(host, port), clock, listen=listens)
        case TcpAddress(host, port):
            return TcpTransport(resolve(host, port), clock)
        case SerialAddress(device, baud):
            return SerialTransport(device, baud, clock)


def new_socket(address: Address, kind: socket.SocketKind) -> socket.socket:
    """Create a non-blocking socket for this address; raise UserError without IPv6."""
    try:
        made = socket.socket(family(address), kind)
    except OSError as error:
        raise UserError(f"cannot use {spelled(*address)}: {error.strerror}") from error
    made.setblocking(False)
    return made
