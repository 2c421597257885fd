"""MAVLink packets in bytes: where they begin and end, their checksums, not their values."""

import re
import struct
from binascii import crc_hqx
from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.messages import Endpoint

MARKER_V1, MARKER_V2 = 0xFE, 0xFD
MARKER = re.compile(rb"[\xfd\xfe]")
"""Start of a packet."""
SIGNED = 0x01
"""Incompatibility flag of a signed packet."""
SIGNATURE_BYTES = 13
"""Link id, timestamp (6 bytes) and the first 6 bytes of the hash."""
_HEADER_V1 = struct.Struct("<BBBBBB")
"""Marker, payload length, sequence, system, component, message id."""
HEADER = struct.Struct("<BBBBBBBHB")
"""Marker, payload length, incompatible and compatible flags, sequence, system, component, id."""
CHECKSUM_BYTES = 2
_MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
CURRENT_MODE, EVENT = 436, 410
"""Messages of MAVLink's common dialect that pymavlink's ardupilotmega lacks."""
_SEEDS = {number: message.crc_extra for number, message in dialect.mavlink_map.items()}
_SEEDS |= {CURRENT_MODE: 0xC1, EVENT: 0xA0}
"""Last byte under the checksum (crc_extra) by message id."""


class RawPacket(NamedTuple):
    """One packet, with checksum and signature unchecked."""

    data: bytes
    source: Endpoint
    message_id: int
    payload: bytes
    """Payload without the trailing zeros that MAVLink 2 truncates."""
    flags: int
    """Incompatibility flags; none in MAVLink 1."""

    @property
    def sequence(self) -> int:
        """Sender's sequence number, 0 to 255."""
        return self.data[2 if self.data[0] == MARKER_V1 else 4]

    @property
    def is_sound(self) -> bool | None:
        """True if the checksum is valid; None if the message is unknown."""
        if (seed := _SEEDS.get(self.message_id)) is None:
            return None
        header = _HEADER_V1 if self.data[0] == MARKER_V1 else HEADER
        end = header.size + len(self.payload)
        return checksum(self.data[1:end], seed) == self.data[end : end + CHECKSUM_BYTES]


def checksum(data: bytes, crc_extra: int) -> bytes:
    """Return the CRC-16/MCRF4XX of a packet without its marker, followed by crc_extra."""
    crc = crc_hqx((data + bytes((crc_extra,))).translate(_MIRRORED), 0xFFFF)
    return crc.to_bytes(CHECKSUM_BYTES, "big").translate(_MIRRORED)


def frame_at(data: bytes, at: int) -> RawPacket | None:
    """Return the packet that begins at ``at``; None if there is no complete one."""
    room = len(data) - at
    if room >= HEADER.size and data[at] == MARKER_V2:
        _, length, flags, _, _, system, component, low, high = HEADER.unpack_from(data, at)
        start, number = at + HEADER.size, low | high << 16
    elif room >= _HEADER_V1.size and data[at] == MARKER_V1:
        _, length, _, system, component, number = _HEADER_V1.unpack_from(data, at)
        start, flags = at + _HEADER_V1.size, 0
    else:
        return None
    end = start + length + CHECKSUM_BYTES + (SIGNATURE_BYTES if flags & SIGNED else 0)
    if end > len(data):
        return None
    source, payload = Endpoint(system, component), data[start : start + length]
    return RawPacket(data[at:end], source, number, payload, flags)
