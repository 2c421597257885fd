"""The packets between each state and its sticks, without pymavlink's general parser and packer.

The same result in less than half of the time; anything unusual is left to pymavlink.
"""

import struct
from collections import namedtuple
from collections.abc import Sequence
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec.messages import Endpoint, ReceivedMessage
from mavbridge.mavlink.codec.readers import READERS, UnusableError

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
    for message in (
        dialect.MAVLink_attitude_quaternion_message,
        dialect.MAVLink_local_position_ned_message,
        dialect.MAVLink_highres_imu_message,
    )
}


def decode_state_packet(data: bytes) -> ReceivedMessage | None:
    """Decode one whole, unsigned, sound and usable packet of a state message; otherwise None."""
    if len(data) < _HEADER_BYTES + _CHECKSUM_BYTES:
        return None
    start, length, incompatible, _, sequence, system, component, low, high = _HEADER.unpack_from(
        data
    )
    layout = _LAYOUTS.get(low | high << 16)
    if layout is None or start != _MAVLINK_2 or incompatible:
        return None
    if len(data) != _HEADER_BYTES + length + _CHECKSUM_BYTES or length > layout.payload.size:
        return None
    if _checksum(data[1:-_CHECKSUM_BYTES], layout.crc_extra) != data[-_CHECKSUM_BYTES:]:
        return None
    payload = data[_HEADER_BYTES:-_CHECKSUM_BYTES].ljust(layout.payload.size, b"\0")
    values = layout.payload.unpack(payload)[: len(layout.fields._fields)]
    try:
        body = READERS[layout.name](layout.fields._make(values))
    except UnusableError:
        return None  # counted by the general parser
    return ReceivedMessage(Endpoint(system, component), sequence, layout.name, body, data)


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
