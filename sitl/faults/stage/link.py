"""A link that loses, doubles, changes or delays packets; a seed always gives the same faults."""

import heapq
from dataclasses import dataclass

import numpy as np

from sitl.clock import NS_PER_MS, NS_PER_S

QUEUE_NS = 500 * NS_PER_MS
"""A link of limited bandwidth holds what it needs so long for, and drops what comes on top."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFaults:
    """Probabilities per packet, each in [0, 1], and times."""

    loss: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0  # one byte is changed
    reorder: float = 0.0  # the packet is held back by ``reorder_ms``, so later ones overtake it
    reorder_ms: float = 20.0
    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    """Each packet is late by up to this much more, evenly spread; later ones overtake it."""
    silence_ns: tuple[int, int] | None = None
    """From and until (not included) on the caller's clock: what is sent meanwhile is lost."""
    hole_ms: float = 0.0
    """All packets are lost for this long, again and again, ..."""
    hole_every_ms: float = 0.0
    """... about every so often: between half and one and a half of this is between two holes."""
    bytes_per_s: float = 0.0
    """Bandwidth; packets wait for those before them, up to ``QUEUE_NS``. 0: unlimited."""


class FaultyLink:
    """One direction of a link: packets in, the surviving ones out when they are due."""

    def __init__(self, faults: LinkFaults, seed: int) -> None:
        self._faults = faults
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._in_flight: list[tuple[int, int, bytes]] = []
        self._sent = 0
        self._hole_ns: int | None = None
        """Start of the present or next hole."""
        self._free_ns = 0
        """When the last packet has passed a link of limited bandwidth."""

    def send(self, packet: bytes, now_ns: int) -> None:
        """Put a packet on the link."""
        silence_ns = self._faults.silence_ns
        if silence_ns is not None and silence_ns[0] <= now_ns < silence_ns[1]:
            return
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
        """When the next packet arrives; None while none is on its way."""
        return self._in_flight[0][0] if self._in_flight else None

    def receive(self, now_ns: int) -> list[bytes]:
        """Packets that have arrived by now, in order of arrival."""
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
        """When the packet has passed the link's bandwidth; None: it finds the queue full."""
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
