"""Packets on their way to a recorder: the link pays for an append and never waits."""

from collections import deque

from mavbridge.core.records import Packet

CAPACITY = 16384
"""Packets that may wait: ten seconds of a busy link."""


class PacketLog:
    """Implements ``ports.PacketSource``: the link appends, another thread drains."""

    def __init__(self) -> None:
        self._packets: deque[Packet] = deque()
        self.dropped = 0

    def append(self, packet: Packet) -> None:
        """Keep a packet that has arrived or left; drop and count it if nobody drains."""
        if len(self._packets) < CAPACITY:
            self._packets.append(packet)
        else:
            self.dropped += 1

    def drain(self) -> list[Packet]:
        """Packets of both directions since the last call."""
        return [self._packets.popleft() for _ in range(len(self._packets))]
