"""Capacity of a serial port against what is asked of it."""

from collections.abc import Iterable

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.mavlink.profiles.profile import Danger, ParamNote, StreamGroup

_FRAME_BYTES = 12
"""Header and checksum of MAVLink 2."""
_OVERRIDE_BYTES = 30
"""RC_CHANNELS_OVERRIDE of eight channels; MANUAL_CONTROL is shorter."""
_OTHERS_BYTES_PER_S = 500
"""Heartbeats, TIMESYNC and requests, in either direction."""
_BITS_PER_BYTE = 10
"""One start bit, eight data bits, one stop bit."""
_STANDARD_BAUDS = (57600, 115200, 230400, 460800, 921600, 1500000, 3000000)


def received_bytes_per_s(streams: Iterable[StreamGroup]) -> float:
    """Need of these streams, in their longest form, without those that seldom come."""
    return _OTHERS_BYTES_PER_S + sum(
        stream.rate_hz * (_FRAME_BYTES + _payload_bytes(stream.messages[0]))
        for stream in streams
        if stream.least_hz is None
    )


def _payload_bytes(name: str) -> int:
    size: int = getattr(dialect, f"MAVLink_{name.lower()}_message").unpacker.size
    return size


def sent_bytes_per_s(stick_hz: float) -> float:
    """Need of our sticks."""
    return _OTHERS_BYTES_PER_S + stick_hz * _OVERRIDE_BYTES


def baud_danger(
    baud: int | None, *, streams: Iterable[StreamGroup], stick_hz: float
) -> Danger | None:
    """Danger of a port whose baud rate is too low, or None; ``baud`` None: not a serial port.

    A serial port carries both directions at once, so the fuller one decides.
    """
    if baud is None:
        return None
    needed = max(received_bytes_per_s(streams), sent_bytes_per_s(stick_hz)) * _BITS_PER_BYTE
    if baud >= needed:
        return None
    enough = next((rate for rate in _STANDARD_BAUDS if rate >= needed), None)
    cure = f"a serial port of {enough} baud on both sides" if enough else "a network link"
    said = (
        f"{baud} baud cannot carry the sticks and states that are asked for ({needed:.0f} bit/s): "
        f"use --connect with {cure}, or a lower rates.action"
    )
    return Danger("slow-serial", ParamNote((), said))
