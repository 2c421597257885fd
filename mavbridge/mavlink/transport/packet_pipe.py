"""Packets into the pipe of a recording, from the process that must not wait for anything."""

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
    """A ``PacketLog`` that writes a telemetry log, as MAVProxy and the ground stations read it.

    Eight bytes precede every packet: Unix time in microseconds, big-endian. Its lowest two bits are
    the number of the link (pymavlink's mavlogfile reads them so), here always 0. A record goes into
    the pipe whole or not at all, without waiting (pipe(7): writes up to PIPE_BUF bytes are atomic).
    """

    def __init__(self, fd: int, *, wall_offset_ns: int) -> None:
        """Take over the write end of a pipe; the offset leads from stamps to Unix time."""
        os.set_blocking(fd, False)
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            with suppress(OSError):  # the user has many pipes: the usual 64 KiB must do
                fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        self._fd: int | None = fd
        self._offset_ns = wall_offset_ns
        self._has_reader = True
        self.dropped = 0
        """Packets that are not in the log: the pipe was full, or its reader is gone."""

    def put(self, packet: Packet, /) -> None:
        """Write the packet, or drop and count it; neither waits nor raises."""
        stamp_us = (packet.stamp_ns + self._offset_ns) // 1000 & ~_LINK_MASK
        record = _STAMP.pack(stamp_us) + packet.data
        if self._fd is None or not self._has_reader or len(record) > select.PIPE_BUF:
            self.dropped += 1
            return
        try:
            os.write(self._fd, record)
        except BlockingIOError:
            self.dropped += 1
        except OSError:  # Python ignores SIGPIPE, so a reader that is gone is an error like others
            self.dropped += 1
            self._has_reader = False

    def close(self) -> None:
        """Let the reader see the end of the log. May be called twice."""
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)
