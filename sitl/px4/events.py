"""What the vehicle says: status texts, and the events of MAVLink's EVENT(410).

An event's id is the autopilot's component in its top byte and a hash of the event's name below it
(MAVLink's events interface); its arguments are packed in order, without padding.
"""

import struct
from typing import NamedTuple

SEVERITY_CRITICAL, SEVERITY_INFO = 2, 6
LEVELS_INFO, LEVELS_DENIED, LEVELS_FAILSAFE = 0x66, 0x62, 0x42
"""Levels for the outside and, in the upper half, for the vehicle's own log: 2 critical, 6 info."""
_AUTOPILOT_COMPONENT = 1 << 24
_FNV1A_32_OFFSET, _FNV1A_32_PRIME = 0x811C9DC5, 0x01000193

ARM_REASON_GESTURE, ARM_REASON_COMMAND, ARM_REASON_LANDING = 1, 4, 6
ARM_REASON_INACTION = 7
"""Reasons of arming and disarming, as the events carry them."""
REASON_NAMES = {
    ARM_REASON_GESTURE: "stick gesture",
    ARM_REASON_COMMAND: "external command",
    ARM_REASON_LANDING: "landing",
    ARM_REASON_INACTION: "auto preflight disarming",
}

ACTION_POSCTL, ACTION_RTL, ACTION_TERMINATE = 2, 6, 10
CAUSE_STICKS_LOST = 1


class Event(NamedTuple):
    """One EVENT; ``uptime_ms`` is its time since boot."""

    name: str
    levels: int
    arguments: bytes
    uptime_ms: int

    @property
    def number(self) -> int:
        """The id on the wire."""
        value = _FNV1A_32_OFFSET
        for letter in self.name.encode():
            value = (value ^ letter) * _FNV1A_32_PRIME & 0xFFFFFFFF
        return _AUTOPILOT_COMPONENT | value & 0xFFFFFF


def pack(layout: str, *values: float) -> bytes:
    """Arguments of an event: `struct` letters without padding."""
    return struct.pack("<" + layout, *values)
