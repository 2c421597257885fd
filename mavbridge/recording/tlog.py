"""Telemetry logs as MAVProxy and the ground stations read them.

Eight bytes precede every packet: Unix time in microseconds, big-endian. Its lowest two bits are the
number of the link (pymavlink's mavlogfile reads them so), here always 0.
"""

import struct
from collections.abc import Iterable
from pathlib import Path

from mavbridge.core.records import Packet

_STAMP = struct.Struct(">Q")
_LINK_MASK = 0b11


class TlogWriter:
    """One ``.tlog`` file; every method may raise OSError where it cannot be written."""

    def __init__(self, path: Path, *, wall_offset_ns: int) -> None:
        """Create the file, which must not exist; the offset leads from stamps to wall time."""
        self._file = path.open("xb")
        self._offset_ns = wall_offset_ns

    def append(self, packets: Iterable[Packet]) -> None:
        """Hand packets to the kernel."""
        for packet in sorted(packets, key=lambda packet: packet.stamp_ns):
            stamp_us = (packet.stamp_ns + self._offset_ns) // 1000 & ~_LINK_MASK
            self._file.write(_STAMP.pack(stamp_us) + packet.data)
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()
