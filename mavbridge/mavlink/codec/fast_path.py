"""Whole packets of MAVLink 2 without pymavlink's general parser and packer.

The same result in less than half of the time; anything unusual is left to pymavlink: MAVLink 1,
streams, messages with arrays. Messages that pymavlink's dialect lacks are decoded here alone.
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
"""Channels 1 to 8, target system and component; channels 9 to 18 are zeros, which are cut off."""


class _Layout(NamedTuple):
    """Wire layout of a message; ``fields`` has pymavlink's names, so its reader serves here.

    Of an array, which only stands at the end, ``fields`` has the first element.
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
    if message.msgname == "ATTITUDE_QUATERNION"  # its array is at the end, and not used
    or (message.msgname in READERS and not any(message.array_lengths))
}
_UNREAD: dict[int, str] = {
    message.id: message.msgname
    for message in dialect.mavlink_map.values()
    if message.msgname not in READERS
}
"""Messages of which nothing but the sequence number is used."""

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
"""Messages of MAVLink's common dialect that pymavlink's one for ArduPilot does not have, by number;
layouts as in common.xml, whose fields go by falling size on the wire."""
MISSING_IDS = {layout.name: number for number, layout in _MISSING_LAYOUTS.items()}
_LAYOUTS |= _MISSING_LAYOUTS
CRC_EXTRA: dict[int, int] = {
    number: message.crc_extra for number, message in dialect.mavlink_map.items()
} | {number: layout.crc_extra for number, layout in _LAYOUTS.items()}
"""Seed of each message's checksum, by the number of the message."""


def packet_end(data: bytes, at: int) -> int | None:
    """End of the packet of MAVLink 2 that begins here; None if there is no whole one."""
    if len(data) - at < _HEADER_BYTES + _CHECKSUM_BYTES or data[at] != _MAVLINK_2:
        return None
    end = at + _HEADER_BYTES + data[at + 1] + _CHECKSUM_BYTES
    end += SIGNATURE_BYTES if data[at + 2] & SIGNED else 0
    return end if end <= len(data) else None


def decode_packet(data: bytes) -> ReceivedMessage | None:
    """Decode one whole, sound and usable packet; None if it is anything else, or has an array.

    A signature is left to the caller.
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
        return None  # counted by the general parser
    return ReceivedMessage(source, sequence, layout.name, body, data)


def pack_override(
    source: Endpoint, sequence: int, target: Endpoint, channels_us: Sequence[int]
) -> bytes:
    """RC_CHANNELS_OVERRIDE of channels 1 to 8. MAVLink 2 cuts trailing zeros off a payload."""
    payload = _OVERRIDE_PAYLOAD.pack(*channels_us, *target).rstrip(b"\0") or b"\0"
    header = _HEADER.pack(_MAVLINK_2, len(payload), 0, 0, sequence, *source, _OVERRIDE.id, 0)
    packet = header + payload
    return packet + _checksum(packet[1:], _OVERRIDE.crc_extra)


def _checksum(data: bytes, crc_extra: int) -> bytes:
    """CRC-16/MCRF4XX over a packet without its marker, followed by the message's crc_extra."""
    crc: int = dialect.x25crc(data + bytes((crc_extra,))).crc
    return crc.to_bytes(_CHECKSUM_BYTES, "little")
