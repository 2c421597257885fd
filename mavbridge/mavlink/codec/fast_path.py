"""Fast decoder and encoder of whole MAVLink 2 packets, in place of pymavlink's general ones.

The result is the same in less than half the time. Unusual input is left to pymavlink: MAVLink 1,
streams, messages with arrays. Messages that pymavlink's dialect lacks are decoded only here.
"""

import struct
from collections import namedtuple
from collections.abc import Sequence
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.messages import Endpoint, ReceivedMessage
from mavbridge.mavlink.codec.readers import READERS, UnusableError
from mavbridge.mavlink.codec.signing import SIGNATURE_BYTES, SIGNED

_MAVLINK_2 = 0xFD
_HEADER = struct.Struct("<BBBBBBBHB")
"""Marker, payload length, incompatible and compatible flags, sequence, system, component, id."""
_HEADER_BYTES, _CHECKSUM_BYTES = 10, 2
_OVERRIDE = dialect.MAVLink_rc_channels_override_message
_OVERRIDE_PAYLOAD = struct.Struct("<8H2B")
"""Channels 1 to 8, target system and component. Channels 9 to 18 are zeros, which are truncated."""


class _Layout(NamedTuple):
    """Wire layout of a message; ``fields`` has pymavlink's names, so that one reader serves both.

    An array is always the last field; ``fields`` holds its first element.
    """

    name: str
    crc_extra: int
    payload: struct.Struct
    fields: Any


_LAYOUTS = {
    message.id: _Layout(
        message.msgname,
        message.crc_extra,
        struct.Struct(message.unpacker.format),
        namedtuple(message.msgname, message.ordered_fieldnames),
    )
    for message in dialect.mavlink_map.values()
    if message.msgname == "ATTITUDE_QUATERNION"  # its array comes last, and is not used
    or (message.msgname in READERS and not any(message.array_lengths))
}
_UNREAD: dict[int, str] = {
    message.id: message.msgname
    for message in dialect.mavlink_map.values()
    if message.msgname not in READERS
}
"""Messages of which only the sequence number is used."""

_MISSING_LAYOUTS = {
    436: _Layout(
        "CURRENT_MODE",
        193,
        struct.Struct("<IIB"),
        namedtuple("CURRENT_MODE", "custom_mode intended_custom_mode standard_mode"),
    ),
    410: _Layout(
        "EVENT",
        160,
        struct.Struct("<IIHBBB40s"),
        namedtuple("EVENT", "id time_boot_ms sequence component system log_levels arguments"),
    ),
}
"""Messages of MAVLink's common dialect that pymavlink's ardupilotmega lacks, by id. Layouts from
common.xml; on the wire, fields are sorted by decreasing size."""
MISSING_IDS = {layout.name: number for number, layout in _MISSING_LAYOUTS.items()}
_LAYOUTS |= _MISSING_LAYOUTS
CRC_EXTRA: dict[int, int] = {
    number: message.crc_extra for number, message in dialect.mavlink_map.items()
} | {number: layout.crc_extra for number, layout in _LAYOUTS.items()}
"""Checksum seed (crc_extra) by message id."""


def packet_end(data: bytes, at: int) -> int | None:
    """Return the end of the MAVLink 2 packet at ``at``; None if there is no whole one."""
    if len(data) - at < _HEADER_BYTES + _CHECKSUM_BYTES or data[at] != _MAVLINK_2:
        return None
    end = at + _HEADER_BYTES + data[at + 1] + _CHECKSUM_BYTES
    end += SIGNATURE_BYTES if data[at + 2] & SIGNED else 0
    return end if end <= len(data) else None


def decode_packet(data: bytes) -> ReceivedMessage | None:
    """Decode one whole, valid and usable packet without arrays; return None for anything else.

    The caller checks the signature.
    """
    if len(data) < _HEADER_BYTES + _CHECKSUM_BYTES:
        return None
    start, length, incompatible, _, sequence, system, component, low, high = _HEADER.unpack_from(
        data
    )
    number = low | high << 16
    layout, unread = _LAYOUTS.get(number), _UNREAD.get(number)
    if start != _MAVLINK_2 or incompatible not in (0, SIGNED):
        return None
    crc_extra = CRC_EXTRA.get(number)
    if crc_extra is None or (layout is None and unread is None):
        return None
    sealed = data[:-SIGNATURE_BYTES] if incompatible else data
    if len(sealed) != _HEADER_BYTES + length + _CHECKSUM_BYTES:
        return None
    if _checksum(sealed[1:-_CHECKSUM_BYTES], crc_extra) != sealed[-_CHECKSUM_BYTES:]:
        return None
    source = Endpoint(system, component)
    if unread is not None:
        return ReceivedMessage(source, sequence, unread, None, data)
    if layout is None or length > layout.payload.size:
        return None
    payload = sealed[_HEADER_BYTES:-_CHECKSUM_BYTES].ljust(layout.payload.size, b"\0")
    values = layout.payload.unpack(payload)[: len(layout.fields._fields)]
    try:
        body = READERS[layout.name](layout.fields._make(values))
    except UnusableError:
        return None  # the general parser counts it
    return ReceivedMessage(source, sequence, layout.name, body, data)


def pack_override(
    source: Endpoint, sequence: int, target: Endpoint, channels_us: Sequence[int]
) -> bytes:
    """Encode RC_CHANNELS_OVERRIDE of channels 1 to 8, without trailing zeros (MAVLink 2)."""
    payload = _OVERRIDE_PAYLOAD.pack(*channels_us, *target).rstrip(b"\0") or b"\0"
    header = _HEADER.pack(_MAVLINK_2, len(payload), 0, 0, sequence, *source, _OVERRIDE.id, 0)
    packet = header + payload
    return packet + _checksum(packet[1:], _OVERRIDE.crc_extra)


def _checksum(data: bytes, crc_extra: int) -> bytes:
    """Return the CRC-16/MCRF4XX of a packet without its marker, followed by crc_extra."""
    crc: int = dialect.x25crc(data + bytes((crc_extra,))).crc
    return crc.to_bytes(_CHECKSUM_BYTES, "little")
