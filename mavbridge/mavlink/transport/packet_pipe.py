"""Non-blocking pipe from the guard to the recording of packets."""

import fcntl
import os
import select
import struct
from contextlib import suppress

from mavbridge.core.vehicle import Packet

PIPE_BYTES = 1 << 20
"""Half a minute of a busy link; the most that Linux grants without privileges (pipe(7))."""
_STAMP = struct.Struct(">Q")
_LINK_MASK = 0b11


class PacketPipe:
    """``PacketLog`` that writes a telemetry log in the format of MAVProxy and ground stations.

    Eight bytes precede every packet: Unix time in microseconds, big-endian. The lowest two bits are
    the link number (as in pymavlink's mavlogfile), here always 0. A record is written to the pipe
    whole or not at all, without blocking (pipe(7): writes up to PIPE_BUF bytes are atomic).
    """

    def __init__(self, fd: int, *, wall_offset_ns: int) -> None:
        """Take over the write end of a pipe; ``wall_offset_ns`` converts stamps to Unix time."""
        os.set_blocking(fd, False)
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            with suppress(OSError):  # the user's pipe quota is used up: keep the default of 64 KiB
                fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._fd: int | None = fd
        self._offset_ns = wall_offset_ns
        self._has_reader = True
        self.dropped = 0
        """Number of packets missing from the log because the pipe was full or its reader gone."""

    def put(self, packet: Packet, /) -> None:
        """Write the packet, or drop and count it; neither block nor raise."""
        stamp_us = (packet.stamp_ns + self._offset_ns) // 1000 & ~_LINK_MASK
        record = _STAMP.pack(stamp_us) + packet.data
        if self._fd is None or not self._has_reader or len(record) > select.PIPE_BUF:
            self.dropped += 1
            return
        try:
            os.write(self._fd, record)
        except BlockingIOError:
            self.dropped += 1
        except OSError:  # reader gone: an error, since Python ignores SIGPIPE
            self.dropped += 1
            self._has_reader = False

    def close(self) -> None:
        """Close the pipe: the reader sees the end of the log. Safe to call twice."""
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)
