"""Reader of telemetry logs: 8 bytes of Unix time [us] before each packet."""

import mmap
import os
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.frames import RawPacket, frame_at
from mavbridge.mavlink.codec.messages import Endpoint

_STAMP_BYTES = 8
"""Timestamp size; big-endian, unsigned."""
_MARKER = re.compile(rb"[\xfd\xfe]")


@dataclass
class Skipped:
    """Damage that ``read_tlog`` has skipped."""

    bytes: int = 0
    """Number of bytes outside any packet."""
    packets: int = 0
    """Lost packets, by gaps in the senders' sequence numbers around the damage; at least one."""

    def describe(self, path: Path) -> str | None:
        """Return a sentence for the user; None if nothing was skipped."""
        if not self.bytes:
            return None
        return (
            f"{path} is damaged, or of another MAVLink dialect: {self.bytes} bytes were skipped, "
            f"with {self.packets} packets"
        )


def read_tlog(path: Path, skipped: Skipped | None = None) -> Iterator[tuple[int, RawPacket]]:
    """Yield Unix time [us] and packet of each record of a log written by ``PacketPipe``.

    After damage, which is counted in ``skipped``, reading resumes at the next valid checksum. The
    checksum of an unknown message cannot be tested; its packet counts if another one follows.

    Raises:
        UserError: the log cannot be read.
    """
    skipped = Skipped() if skipped is None else skipped
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size:
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                    yield from _records(data, skipped)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


def _records(data: mmap.mmap, skipped: Skipped) -> Iterator[tuple[int, RawPacket]]:
    at, newest, unsure = 0, dict[Endpoint, int](), set[Endpoint]()
    while at < len(data):
        packet = _packet_at(data, at)
        if packet is None:
            behind = _next_sound(data, at + 1, len(data))
            skipped.bytes += (len(data) if behind is None else behind) - at
            skipped.packets += behind is None or not newest
            if behind is None:
                return
            at, unsure = behind, set(newest)  # senders not heard since the damage
            continue
        if packet.source in unsure:
            unsure.remove(packet.source)
            skipped.packets += (packet.sequence - newest[packet.source] - 1) % 256
        newest[packet.source] = packet.sequence
        yield int.from_bytes(data[at : at + _STAMP_BYTES], "big"), packet
        at += _STAMP_BYTES + len(packet.data)


def _packet_at(data: mmap.mmap, at: int) -> RawPacket | None:
    """Return the packet of the record at ``at`` if its checksum is valid.

    If it cannot be tested, another record must follow the packet, and none begin inside it.
    """
    packet = frame_at(data, at + _STAMP_BYTES)
    if packet is None or (is_sound := packet.is_sound) is False:
        return None
    end = at + _STAMP_BYTES + len(packet.data)
    is_followed = end == len(data) or frame_at(data, end + _STAMP_BYTES) is not None
    is_record = is_followed and _next_sound(data, at + 1, end) is None
    return packet if is_sound or is_record else None


def _next_sound(data: mmap.mmap, at: int, end: int) -> int | None:
    """Return the start of the first record in this range with a valid checksum."""
    for marker in _MARKER.finditer(data, at + _STAMP_BYTES, end + _STAMP_BYTES):
        packet = frame_at(data, marker.start())
        if packet is not None and packet.is_sound:
            return marker.start() - _STAMP_BYTES
    return None
