"""Link from the relay to the bridge: seeded faults, over UDP, TCP or a serial port."""

import heapq
import os
import pty
import socket
import tty
from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from sitl.clock import NS_PER_MS, NS_PER_S, Clock

QUEUE_NS = 500 * NS_PER_MS
"""Longest wait for bandwidth; a packet that would wait longer is dropped."""
LOOPBACK = "127.0.0.1"
MOST_BYTES = 65536
BITS_PER_BYTE = 10  # 8 data bits, a start bit and a stop bit
LINE_BUFFER = 4096
"""Buffer size of a serial driver."""
SERIAL_PACE_S = 0.002


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFaults:
    """Probabilities per packet, each in [0, 1], and times."""

    loss: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0  # one byte is changed
    reorder: float = 0.0  # held back by ``reorder_ms``, so that later packets overtake it
    reorder_ms: float = 20.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    """Largest additional random delay, uniformly distributed; packets can overtake each other."""
    hole_ms: float = 0.0
    """Length of each gap in which every packet is lost."""
    hole_every_ms: float = 0.0
    """Mean time between two gaps; each is 0.5 to 1.5 times this."""
    bytes_per_s: float = 0.0
    """Bandwidth; 0: unlimited."""


class FaultyLink:
    """One direction of a link: packets in, surviving packets out when they are due."""

    def __init__(self, faults: LinkFaults, seed: int) -> None:
        self._faults = faults
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._in_flight: list[tuple[int, int, bytes]] = []
        self._sent = 0
        self._hole_ns: int | None = None  # start of the current or next hole
        self._free_ns = 0  # when the last packet has passed a link of limited bandwidth

    def send(self, packet: bytes, now_ns: int) -> None:
        if self._is_in_hole(now_ns) or self._happens(self._faults.loss):
            return
        for _ in range(2 if self._happens(self._faults.duplicate) else 1):
            passed_ns = self._passed_ns(packet, now_ns)
            if passed_ns is None:
                continue
            delay_ms = self._faults.delay_ms
            if self._happens(self._faults.reorder):
                delay_ms += self._faults.reorder_ms
            if self._faults.jitter_ms > 0:
                delay_ms += float(self._random.random()) * self._faults.jitter_ms
            due_ns = passed_ns + round(delay_ms * NS_PER_MS)
            heapq.heappush(self._in_flight, (due_ns, self._sent, self._maybe_corrupt(packet)))
            self._sent += 1

    @property
    def due_ns(self) -> int | None:
        """Arrival of the next packet; None while none is in flight."""
        return self._in_flight[0][0] if self._in_flight else None

    def receive(self, now_ns: int) -> list[bytes]:
        """Return the packets that have arrived by now, in order of arrival."""
        arrived = []
        while self._in_flight and self._in_flight[0][0] <= now_ns:
            arrived.append(heapq.heappop(self._in_flight)[2])
        return arrived

    def _is_in_hole(self, now_ns: int) -> bool:
        if self._faults.hole_ms <= 0:
            return False
        hole_ns = round(self._faults.hole_ms * NS_PER_MS)
        if self._hole_ns is None:
            self._hole_ns = now_ns + self._until_hole_ns()
        while now_ns >= self._hole_ns + hole_ns:
            self._hole_ns += hole_ns + self._until_hole_ns()
        return now_ns >= self._hole_ns

    def _until_hole_ns(self) -> int:
        return round((0.5 + self._random.random()) * self._faults.hole_every_ms * NS_PER_MS)

    def _passed_ns(self, packet: bytes, now_ns: int) -> int | None:
        """Return when the packet has passed the limited bandwidth; None: the queue is full."""
        if self._faults.bytes_per_s <= 0:
            return now_ns
        if self._free_ns - now_ns > QUEUE_NS:
            return None
        needed_ns = round(len(packet) / self._faults.bytes_per_s * NS_PER_S)
        self._free_ns = max(self._free_ns, now_ns) + needed_ns
        return self._free_ns

    def _maybe_corrupt(self, packet: bytes) -> bytes:
        if not packet or not self._happens(self._faults.corrupt):
            return packet
        at = int(self._random.integers(len(packet)))
        flipped = packet[at] ^ int(self._random.integers(1, 256))
        return packet[:at] + bytes([flipped]) + packet[at + 1 :]

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and float(self._random.random()) < probability


class Carrier(ABC):
    """The vehicle's end of the bridge's link. `fail` can be called by any thread."""

    is_stream = True
    """True if a read can end inside a packet."""
    wait_s = 0.2
    """Longest time until the next poll."""

    def __init__(self, address: str) -> None:
        self.address = address
        """Value for the bridge's ``--connect``."""
        self.has_failed = False

    def fail(self) -> None:
        """Break at the next poll: UDP continues from another port, TCP closes and accepts a new
        connection, a serial port is unplugged."""
        self.has_failed = True

    def descriptors(self) -> list[int]:
        """Return the descriptors that become readable when there is something to receive."""
        return []

    @abstractmethod
    def receive(self) -> list[bytes]:
        """Return data from the bridge without waiting."""

    @abstractmethod
    def send(self, packet: bytes) -> None:
        """Send to the bridge; drop the packet if that is not possible now."""

    @abstractmethod
    def close(self) -> None: ...


class UdpCarrier(Carrier):
    """UDP link: the bridge listens, and answers the address that it has received from."""

    is_stream = False

    def __init__(self, bridge_port: int) -> None:
        super().__init__(f"udp:{LOOPBACK}:{bridge_port}")
        self.bridge = (LOOPBACK, bridge_port)
        self._socket = self._open()

    def _open(self) -> socket.socket:
        udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        udp.bind((LOOPBACK, 0))
        udp.setblocking(False)
        return udp

    def descriptors(self) -> list[int]:
        return [self._socket.fileno()]

    def receive(self) -> list[bytes]:
        if self.has_failed:
            self.has_failed = False
            self._socket.close()
            self._socket = self._open()
        with suppress(BlockingIOError, ConnectionError):
            data, sender = self._socket.recvfrom(MOST_BYTES)
            return [data] if sender == self.bridge else []
        return []

    def send(self, packet: bytes) -> None:
        with suppress(BlockingIOError, ConnectionError):
            self._socket.sendto(packet, self.bridge)

    def close(self) -> None:
        self._socket.close()


class TcpCarrier(Carrier):
    """TCP link: the bridge connects; the newest connection counts."""

    def __init__(self) -> None:
        self._server = socket.create_server((LOOPBACK, 0))
        self._server.setblocking(False)
        self._connection: socket.socket | None = None
        super().__init__(f"tcp:{LOOPBACK}:{self._server.getsockname()[1]}")

    def descriptors(self) -> list[int]:
        ours = [] if self._connection is None else [self._connection.fileno()]
        return [self._server.fileno(), *ours]

    def receive(self) -> list[bytes]:
        if self.has_failed:
            self.has_failed = False
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
        if self._connection is not None:
            with suppress(OSError):
                self._connection.send(packet)

    def _drop(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None

    def close(self) -> None:
        self._drop()
        self._server.close()


class SerialCarrier(Carrier):
    """A pseudo-terminal that carries both directions at the pace of a serial port.

    The kernel buffers 4,095 bytes for the reader and some 16 kB behind them; a real port has a ring
    of 4,096.
    """

    wait_s = SERIAL_PACE_S

    def __init__(self, baud: int, clock: Clock) -> None:
        self._clock = clock
        self._bytes_per_s = baud / BITS_PER_BYTE
        self._ours, self._theirs = pty.openpty()
        tty.setraw(self._theirs)
        os.set_blocking(self._ours, False)
        super().__init__(f"{os.ttyname(self._theirs)},{baud}")
        self.is_read = True
        """True while the vehicle's end reads; can be changed by any thread."""
        self._unsent = bytearray()
        self._looked_ns = clock.now_ns()
        self._is_gone = False

    def receive(self) -> list[bytes]:
        """Return as many bytes as the wire has carried since the last call."""
        if self.has_failed:
            self.close()
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
        if not self._is_gone and len(self._unsent) + len(packet) <= LINE_BUFFER:
            self._unsent += packet

    def close(self) -> None:
        if not self._is_gone:
            self._is_gone = True
            os.close(self._theirs)
            os.close(self._ours)
