"""What carries packets between the relay and the bridge: UDP, TCP or a serial port."""

import os
import pty
import socket
import tty
from contextlib import suppress
from typing import Literal, Protocol, TypeAlias

from sitl.clock import NS_PER_S, Clock

CarrierName: TypeAlias = Literal["udp", "tcp", "serial"]
LOOPBACK = "127.0.0.1"
MOST_BYTES = 65536
BITS_PER_BYTE = 10
"""Bits on a serial line for a byte: 8, and a start and a stop bit."""
LINE_BUFFER = 4096
"""A serial driver's ring of bytes that wait to be sent."""
PACE_S = 0.002
"""Between two looks at a serial port, whose bytes come one by one."""
WAIT_S = 0.2
"""Between two looks at the clock where nothing comes."""


class Carrier(Protocol):
    """The vehicle's end of the bridge's link; used by the relay's thread, except where said."""

    address: str
    """For the bridge's ``--connect``."""
    is_stream: bool
    """What is received may end anywhere in a packet."""
    wait_s: float
    """Longest time until the next look at it."""

    def descriptors(self) -> list[int]:
        """Those that turn readable when there is something to receive."""

    def receive(self) -> list[bytes]:
        """What has come from the bridge; never waits."""

    def send(self, packet: bytes) -> None:
        """Send to the bridge; dropped where that cannot be now."""

    def fail(self) -> None:
        """Break, as this kind of link does: UDP comes from another port from now on, TCP closes and
        takes a new connection, a serial port is unplugged. By any thread."""

    def close(self) -> None:
        """Free everything."""


class UdpCarrier:
    """The bridge listens; its packets go back to whom it has heard."""

    is_stream = False
    wait_s = WAIT_S

    def __init__(self, bridge_port: int) -> None:
        self.address = f"udp:{LOOPBACK}:{bridge_port}"
        self.bridge = (LOOPBACK, bridge_port)
        self._socket = self._open()
        self._has_failed = False

    def _open(self) -> socket.socket:
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp.bind((LOOPBACK, 0))
        udp.setblocking(False)
        return udp

    def descriptors(self) -> list[int]:
        """See `Carrier`."""
        return [self._socket.fileno()]

    def receive(self) -> list[bytes]:
        """One datagram."""
        if self._has_failed:
            self._has_failed = False
            self._socket.close()
            self._socket = self._open()
        with suppress(BlockingIOError, ConnectionError):
            data, sender = self._socket.recvfrom(MOST_BYTES)
            return [data] if sender == self.bridge else []
        return []

    def send(self, packet: bytes) -> None:
        """See `Carrier`."""
        with suppress(BlockingIOError, ConnectionError):
            self._socket.sendto(packet, self.bridge)

    def fail(self) -> None:
        """See `Carrier`; happens at the next look."""
        self._has_failed = True

    def close(self) -> None:
        """See `Carrier`."""
        self._socket.close()


class TcpCarrier:
    """The bridge connects; the newest connection counts."""

    is_stream = True
    wait_s = WAIT_S

    def __init__(self) -> None:
        self._server = socket.create_server((LOOPBACK, 0))
        self._server.setblocking(False)
        self.address = f"tcp:{LOOPBACK}:{self._server.getsockname()[1]}"
        self._connection: socket.socket | None = None
        self._has_failed = False

    def descriptors(self) -> list[int]:
        """See `Carrier`."""
        connection = self._connection
        ours = [] if connection is None else [connection.fileno()]
        return [self._server.fileno(), *ours]

    def receive(self) -> list[bytes]:
        """One read."""
        if self._has_failed:
            self._has_failed = False
            self._drop()
        with suppress(BlockingIOError):
            connection = self._server.accept()[0]
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._drop()
            self._connection = connection
        if self._connection is None:
            return []
        try:
            data = self._connection.recv(MOST_BYTES)
        except BlockingIOError:
            return []
        except OSError:
            data = b""
        if not data:
            self._drop()
        return [data] if data else []

    def send(self, packet: bytes) -> None:
        """See `Carrier`."""
        if self._connection is not None:
            with suppress(OSError):
                self._connection.send(packet)

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def fail(self) -> None:
        """See `Carrier`; happens at the next look."""
        self._has_failed = True

    def close(self) -> None:
        """See `Carrier`."""
        self._drop()
        self._server.close()


class SerialCarrier:
    """A pseudo-terminal, both ways at the pace of a serial port.

    The kernel keeps 4,095 bytes for the reader and some 16 kB behind them; a real port has a ring
    of 4,096.
    """

    is_stream = True
    wait_s = PACE_S

    def __init__(self, baud: int, clock: Clock) -> None:
        self._clock = clock
        self._bytes_per_s = baud / BITS_PER_BYTE
        self._ours, self._theirs = pty.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        self.address = f"{os.ttyname(self._theirs)},{baud}"
        self.is_read = True
        """The vehicle's end reads; may be changed by any thread."""
        self._unsent = bytearray()
        self._looked_ns = clock.now_ns()
        self._has_failed = self._is_gone = False

    def descriptors(self) -> list[int]:
        """None: it is looked at by its pace."""
        return []

    def receive(self) -> list[bytes]:
        """As many bytes as have come over the wire since the last look."""
        if self._has_failed and not self._is_gone:
            self._is_gone = True
            os.close(self._theirs)
            os.close(self._ours)
        now_ns = self._clock.now_ns()
        most = round((now_ns - self._looked_ns) / NS_PER_S * self._bytes_per_s)
        if self._is_gone or most == 0:
            return []
        self._looked_ns = now_ns
        with suppress(BlockingIOError):
            written = os.write(self._ours, self._unsent[:most])
            del self._unsent[:written]
        if self.is_read:
            with suppress(BlockingIOError):
                return [os.read(self._ours, min(most, LINE_BUFFER))]
        return []

    def send(self, packet: bytes) -> None:
        """See `Carrier`."""
        if not self._is_gone and len(self._unsent) + len(packet) <= LINE_BUFFER:
            self._unsent += packet

    def fail(self) -> None:
        """See `Carrier`; happens at the next look."""
        self._has_failed = True

    def close(self) -> None:
        """See `Carrier`."""
        if not self._is_gone:
            self._is_gone = True
            os.close(self._theirs)
            os.close(self._ours)
