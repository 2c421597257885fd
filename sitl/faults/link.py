"""A link that loses, doubles, changes or delays packets; a seed always gives the same faults."""

import heapq
from dataclasses import dataclass

import numpy as np

from sitl.clock import NS_PER_MS


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkFaults:
    """Probabilities per packet, each in [0, 1], and times."""

    loss: float = 0.0
    duplicate: float = 0.0
    corrupt: float = 0.0  # one byte is changed
    reorder: float = 0.0  # the packet is held back by ``reorder_ms``, so later ones overtake it
    reorder_ms: float = 20.0
    delay_ms: float = 0.0
    silence_ns: tuple[int, int] | None = None
    """From and until (not included) on the caller's clock: what is sent meanwhile is lost."""


class FaultyLink:
    """One direction of a link: packets in, the surviving ones out when they are due."""

    def __init__(self, faults: LinkFaults, seed: int) -> None:
        self._faults = faults
        self._random = np.random.Generator(np.random.PCG64(seed))
        self._in_flight: list[tuple[int, int, bytes]] = []
        self._sent = 0

    def send(self, packet: bytes, now_ns: int) -> None:
        """Put a packet on the link."""
        silence_ns = self._faults.silence_ns
        if silence_ns is not None and silence_ns[0] <= now_ns < silence_ns[1]:
            return
        if self._happens(self._faults.loss):
            return
        for _ in range(2 if self._happens(self._faults.duplicate) else 1):
            delay_ms = self._faults.delay_ms
            if self._happens(self._faults.reorder):
                delay_ms += self._faults.reorder_ms
            due_ns = now_ns + round(delay_ms * NS_PER_MS)
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

    def _maybe_corrupt(self, packet: bytes) -> bytes:
        if not packet or not self._happens(self._faults.corrupt):
            return packet
        at = int(self._random.integers(len(packet)))
        flipped = packet[at] ^ int(self._random.integers(1, 256))
        return packet[:at] + bytes([flipped]) + packet[at + 1 :]

    def _happens(self, probability: float) -> bool:
        return probability > 0.0 and float(self._random.random()) < probability
