"""Telemetry logs: 8 bytes of Unix time [us] before each packet."""

import fcntl
import os
import select
from contextlib import suppress
from pathlib import Path

from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.frames import MARKER, RawPacket, frame_at

_STAMP_BYTES = 8
"""Timestamp size; big-endian, unsigned."""
_PIPE_BYTES = 1 << 20
"""Half a minute of a busy link; the most that Linux grants without privileges (pipe(7))."""
_LINK_MASK = 0b11


class PacketPipe:
    """Writes a telemetry log in the format of MAVProxy and ground stations.

    Eight bytes precede every packet: Unix time in microseconds, big-endian. The lowest two bits are
    the link number (as in pymavlink's mavlogfile), here always 0. A record is written to the pipe
    whole or not at all, without blocking (pipe(7): writes up to PIPE_BUF bytes are atomic).
    """

    def __init__(self, fd: int, *, wall_offset_ns: int) -> None:
        """Take over the write end of a pipe; ``wall_offset_ns`` converts stamps to Unix time."""
        os.set_blocking(fd, False)
        if hasattr(fcntl, "F_SETPIPE_SZ"):
            with suppress(OSError):  # the user's pipe quota is used up: keep the default of 64 KiB
                fcntl.fcntl(fd, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        self._fd: int | None = fd
        self._offset_ns = wall_offset_ns
        self.dropped = 0
        """Number of packets missing from the log because the pipe was full or its reader gone."""

    def put(self, stamp_ns: int, packet: bytes) -> None:
        """Write a packet that arrived, or was handed to the kernel, at this time, or drop and count
        it; neither block nor raise."""
        stamp_us = (stamp_ns + self._offset_ns) // 1000 & ~_LINK_MASK
        record = stamp_us.to_bytes(_STAMP_BYTES, "big") + packet
        try:
            if self._fd is not None and len(record) <= select.PIPE_BUF:
                os.write(self._fd, record)
                return
        except BlockingIOError:
            pass
        except OSError:  # reader gone: an error, since Python ignores SIGPIPE
            self.close()
        self.dropped += 1

    def close(self) -> None:
        """Close the pipe: the reader sees the end of the log. Safe to call twice."""
        fd, self._fd = self._fd, None
        if fd is not None:
            os.close(fd)


def read_tlog(path: Path) -> tuple[list[tuple[int, RawPacket]], int]:
    """Return Unix time [us] and packet of each record of a log, and the number of skipped bytes.

    After damage, reading resumes at the next valid checksum. The checksum of an unknown message
    cannot be tested; its packet counts if another one follows.

    Raises:
        UserError: the log cannot be read.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    records, at, skipped = [], 0, 0
    while at < len(data):
        packet = _packet_at(data, at)
        if packet is None:
            behind = _next_sound(data, at + 1, len(data))
            skipped, at = skipped + behind - at, behind
            continue
        records.append((int.from_bytes(data[at : at + _STAMP_BYTES], "big"), packet))
        at += _STAMP_BYTES + len(packet.data)
    return records, skipped


def _packet_at(data: bytes, at: int) -> RawPacket | None:
    """Return the packet of the record at ``at`` if its checksum is valid.

    If it cannot be tested, another record must follow the packet, and none begin inside it.
    """
    packet = frame_at(data, at + _STAMP_BYTES)
    if packet is None or (is_sound := packet.is_sound) is False:
        return None
    end = at + _STAMP_BYTES + len(packet.data)
    is_followed = end == len(data) or frame_at(data, end + _STAMP_BYTES) is not None
    is_record = is_followed and _next_sound(data, at + 1, end) == end
    return packet if is_sound or is_record else None


def _next_sound(data: bytes, at: int, end: int) -> int:
    """Return the start of the first record in this range with a valid checksum, else ``end``."""
    for marker in MARKER.finditer(data, at + _STAMP_BYTES, end + _STAMP_BYTES):
        packet = frame_at(data, marker.start())
        if packet is not None and packet.is_sound:
            return marker.start() - _STAMP_BYTES
    return end
