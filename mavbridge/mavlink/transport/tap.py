"""What goes over the link, for whoever records it: the loop pays an append, and never waits."""

from collections import deque

from pymavlink.dialects.v20 import ardupilotmega as dialect
from pymavlink.generator.mavcrc import x25crc

from mavbridge.core.records import Packet
from mavbridge.mavlink.transport.sockets import Chunk

CAPACITY = 8192
"""Datagrams that may wait: ten seconds of a busy link."""

_V1, _V2 = 0xFE, 0xFD
_V1_OVERHEAD, _V2_OVERHEAD = 8, 12
_SIGNATURE_BYTES = 13
_IS_SIGNED = 1
"""incompat_flags."""


class PacketTap:
    """Implements ``ports.PacketSource``. The link's threads put, one other thread drains."""

    def __init__(self) -> None:
        self._received: deque[Chunk] = deque()
        self._sent: deque[Packet] = deque()
        self._framer = Framer()
        self._refused_received = self._refused_sent = 0  # one writer each

    def received(self, chunk: Chunk) -> None:
        """Bytes have come in, as they were cut by the way they came."""
        if len(self._received) < CAPACITY:
            self._received.append(chunk)
        else:
            self._refused_received += 1

    def sent(self, data: bytes, stamp_ns: int) -> None:
        """A packet has left."""
        if len(self._sent) < CAPACITY:
            self._sent.append(Packet(stamp_ns, data))
        else:
            self._refused_sent += 1

    @property
    def dropped(self) -> int:
        """Pieces that nobody drained in time."""
        return self._refused_received + self._refused_sent

    def drain(self) -> list[Packet]:
        """Whole packets of both directions since the last call, and no other bytes."""
        packets = [self._sent.popleft() for _ in range(len(self._sent))]
        for _ in range(len(self._received)):
            chunk = self._received.popleft()
            whole = self._framer.feed(chunk.data, is_datagram=chunk.sender is not None)
            packets += [Packet(chunk.arrived_ns, data) for data in whole]
        return packets


class Framer:
    """Cuts bytes into packets, by their own length and checksum (MAVLink 1 and 2).

    Packets of messages that the dialect does not know are kept: their checksum cannot be judged.
    """

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes, *, is_datagram: bool) -> list[bytes]:
        """Packets completed by these bytes."""
        if is_datagram and data[:1] in (b"\xfd", b"\xfe"):
            self._rest = b""  # of an earlier one that was cut off
        left = self._rest + data
        at, packets = 0, []
        while at < len(left):
            size = _size(left[at : at + 3])
            if size is None or at + size > len(left):
                break
            packet = left[at : at + size]
            if size and _is_whole(packet):
                packets.append(packet)
                at += size
            else:
                at += 1
        self._rest = left[at:]
        return packets


def _size(head: bytes) -> int | None:
    """Bytes of the packet that starts so; 0 = none does, None = too early to say."""
    if head[0] not in (_V1, _V2):
        return 0
    if len(head) < 3:
        return None
    if head[0] == _V1:
        return head[1] + _V1_OVERHEAD
    return head[1] + _V2_OVERHEAD + (_SIGNATURE_BYTES if head[2] & _IS_SIGNED else 0)


def _is_whole(packet: bytes) -> bool:
    """The checksum is right, or cannot be known."""
    payload = packet[1]
    if packet[0] == _V1:
        number, end = packet[5], 6 + payload
    else:
        number, end = int.from_bytes(packet[7:10], "little"), 10 + payload
    message = dialect.mavlink_map.get(number)
    if message is None:
        return True
    crc = x25crc(packet[1:end])
    crc.accumulate(bytes([message.crc_extra]))
    value: int = crc.crc
    return value == int.from_bytes(packet[end : end + 2], "little")
