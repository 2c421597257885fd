"""The packets between every state and its sticks, past pymavlink's general parser and packer.

The same bytes in a quarter of the time; whatever is unusual is left to pymavlink.
"""

import struct
from collections.abc import Callable, Sequence

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.codec import readers
from mavbridge.mavlink.codec.messages import Body, Incoming, Source

_MAVLINK_2 = 0xFD
_HEADER = struct.Struct("<BBBBBBBHB")
"""Marker, payload length, incompatible and compatible flags, sequence, system, component, id."""
_HEADER_BYTES, _CHECKSUM_BYTES = 10, 2
_OVERRIDE = dialect.MAVLink_rc_channels_override_message
_OVERRIDE_PAYLOAD = struct.Struct("<8H2B")
"""Channels 1 to 8, target system and component; channels 9 to 18 are zeros, which are cut off."""


def pack_override(
    source: Source, sequence: int, target: Source, channels_us: Sequence[int]
) -> bytes:
    """RC_CHANNELS_OVERRIDE of channels 1 to 8. MAVLink 2 cuts trailing zeros off a payload."""
    payload = _OVERRIDE_PAYLOAD.pack(*channels_us, *target).rstrip(b"\0") or b"\0"
    header = _HEADER.pack(_MAVLINK_2, len(payload), 0, 0, sequence, *source, _OVERRIDE.id, 0)
    packet = header + payload
    return packet + _checksum(packet[1:], _OVERRIDE.crc_extra)


class _StateMessage:
    """A message that comes with every tick: read from its wire fields, past pymavlink's objects."""

    def __init__(
        self, message: type[dialect.MAVLink_message], read: Callable[[tuple[float, ...]], Body]
    ) -> None:
        self.name: str = message.msgname
        self.crc_extra: int = message.crc_extra
        self.names: tuple[str, ...] = tuple(message.ordered_fieldnames)
        self.payload = struct.Struct(message.unpacker.format)
        self.read = read

    def read_message(self, message: dialect.MAVLink_message) -> Body:
        """From pymavlink's object."""
        return self.read(tuple(getattr(message, name) for name in self.names))


_STATE_MESSAGES = {
    message.id: _StateMessage(message, read)
    for message, read in (
        (dialect.MAVLink_attitude_quaternion_message, readers.attitude_quaternion),
        (dialect.MAVLink_local_position_ned_message, readers.local_position),
        (dialect.MAVLink_highres_imu_message, readers.highres_imu),
    )
}
STATE_READERS = {state.name: state.read_message for state in _STATE_MESSAGES.values()}
"""The same, for packets that came in pieces, signed, or as MAVLink 1."""


def decode_state_packet(data: bytes) -> Incoming | None:
    """A datagram that is one whole, unsigned, sound packet of a state message, or None."""
    if len(data) < _HEADER_BYTES + _CHECKSUM_BYTES:
        return None
    start, length, incompatible, _, sequence, system, component, low, high = _HEADER.unpack_from(
        data
    )
    state = _STATE_MESSAGES.get(low | high << 16)
    if state is None or start != _MAVLINK_2 or incompatible:
        return None
    if len(data) != _HEADER_BYTES + length + _CHECKSUM_BYTES or length > state.payload.size:
        return None
    if _checksum(data[1:-_CHECKSUM_BYTES], state.crc_extra) != data[-_CHECKSUM_BYTES:]:
        return None
    payload = data[_HEADER_BYTES:-_CHECKSUM_BYTES].ljust(state.payload.size, b"\0")
    try:
        body = state.read(state.payload.unpack(payload))
    except readers.UnusableError:
        return None  # counted there
    return Incoming(Source(system, component), sequence, state.name, body)


def _checksum(data: bytes, crc_extra: int) -> bytes:
    """CRC-16/MCRF4XX over a packet without its marker, and the message's own seed."""
    crc: int = dialect.x25crc(data + bytes((crc_extra,))).crc
    return crc.to_bytes(_CHECKSUM_BYTES, "little")
