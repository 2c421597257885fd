"""Reads telemetry logs: 8 bytes of Unix time in us before each packet."""

import mmap
import os
import re
from binascii import crc_hqx
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.fast_path import CRC_EXTRA
from mavbridge.mavlink.codec.frames import RawPacket, frame_at
from mavbridge.mavlink.codec.messages import Endpoint

_STAMP_BYTES = 8
"""Big-endian, unsigned."""
_MARKER = re.compile(rb"[\xfd\xfe]")
_MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass
class Skipped:
    """Damage that ``read_tlog`` has passed over."""

    bytes: int = 0
    """Those that belong to no packet."""
    packets: int = 0
    """By the gaps in the senders' sequence numbers around the damage; at least one."""

    def describe(self, path: Path) -> str | None:
        """Return a sentence for the user; None if nothing was skipped."""
        if not self.bytes:
            return None
        return (
            f"{path} is damaged, or of another MAVLink dialect: {self.bytes} bytes were skipped, "
            f"with {self.packets} packets"
        )


def read_tlog(path: Path, skipped: Skipped | None = None) -> Iterator[tuple[int, RawPacket]]:
    """Unix time in microseconds and packet of each record of a log as ``PacketPipe`` writes it.

    Reads on behind damage, which it counts in ``skipped``, where a checksum fits again. A packet of
    an unknown message, whose checksum cannot be tried, counts where another one follows.

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
            at, unsure = behind, set(newest)  # senders that were not heard since the damage
            continue
        if packet.source in unsure:
            unsure.remove(packet.source)
            skipped.packets += (packet.sequence - newest[packet.source] - 1) % 256
        newest[packet.source] = packet.sequence
        yield int.from_bytes(data[at : at + _STAMP_BYTES], "big"), packet
        at += _STAMP_BYTES + len(packet.data)


def _packet_at(data: mmap.mmap, at: int) -> RawPacket | None:
    """The packet of the record here, if its checksum fits.

    If that cannot be tried, another record must follow it, and none begin inside it.
    """
    packet = frame_at(data, at + _STAMP_BYTES)
    if packet is None or (is_sound := _is_sound(packet)) is False:
        return None
    end = at + _STAMP_BYTES + len(packet.data)
    is_followed = end == len(data) or frame_at(data, end + _STAMP_BYTES) is not None
    is_record = is_followed and _next_sound(data, at + 1, end) is None
    return packet if is_sound or is_record else None


def _is_sound(packet: RawPacket) -> bool | None:
    """True if its checksum fits; None if it is of a message that the dialect lacks."""
    if (extra := CRC_EXTRA.get(packet.message_id)) is None:
        return None
    body, checksum = packet.sealed
    crc = crc_hqx((body + bytes((extra,))).translate(_MIRRORED), 0xFFFF)
    return checksum == crc.to_bytes(2, "big").translate(_MIRRORED)


def _next_sound(data: mmap.mmap, at: int, end: int) -> int | None:
    """Begin of the first record between these places whose checksum fits."""
    for marker in _MARKER.finditer(data, at + _STAMP_BYTES, end + _STAMP_BYTES):
        packet = frame_at(data, marker.start())
        if packet is not None and _is_sound(packet):
            return marker.start() - _STAMP_BYTES
    return None
