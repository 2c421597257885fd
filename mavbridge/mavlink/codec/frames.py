"""Splitting of datagrams into MAVLink packets, without decoding."""

from mmap import mmap
from typing import NamedTuple

from mavbridge.mavlink.codec.messages import Endpoint
from mavbridge.mavlink.codec.signing import SIGNATURE_BYTES, SIGNED

_V1, _V2 = 0xFE, 0xFD
_V1_HEADER, _V2_HEADER, _CHECKSUM = 6, 10, 2


class RawPacket(NamedTuple):
    """One packet, with checksum and signature unchecked."""

    data: bytes
    source: Endpoint
    message_id: int
    payload: bytes
    """Payload without the trailing zeros that MAVLink 2 truncates."""

    @property
    def sequence(self) -> int:
        """Sender's sequence number, 0 to 255."""
        return self.data[2 if self.data[0] == _V1 else 4]

    @property
    def sealed(self) -> tuple[bytes, bytes]:
        """Bytes covered by the checksum, and the received checksum."""
        end = (_V1_HEADER if self.data[0] == _V1 else _V2_HEADER) + len(self.payload)
        return self.data[1:end], self.data[end : end + _CHECKSUM]


def split_frames(data: bytes) -> tuple[list[RawPacket], bool]:
    """Return the packets of a datagram, and True if other bytes were left over."""
    frames: list[RawPacket] = []
    at = 0
    while at < len(data):
        frame = frame_at(data, at)
        if frame is None:
            return frames, True
        frames.append(frame)
        at += len(frame.data)
    return frames, False


def frame_at(data: bytes | mmap, at: int) -> RawPacket | None:
    """Return the packet that begins at ``at``; None if there is no complete one."""
    if at >= len(data):
        return None
    marker = data[at]
    header = _V1_HEADER if marker == _V1 else _V2_HEADER
    if marker not in (_V1, _V2) or len(data) - at < header:
        return None
    length = data[at + 1]
    end = at + header + length + _CHECKSUM
    if marker == _V1:
        system, component, message_id = data[at + 3 : at + 6]
    else:
        system, component = data[at + 5 : at + 7]
        message_id = int.from_bytes(data[at + 7 : at + 10], "little")
        end += SIGNATURE_BYTES if data[at + 2] & SIGNED else 0
    if end > len(data):
        return None
    payload = data[at + header : at + header + length]
    return RawPacket(data[at:end], Endpoint(system, component), message_id, payload)
