"""Reads telemetry logs of any ground station: 8 bytes of Unix time in us before each packet."""

import mmap
import os
import re
from binascii import crc_hqx
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.fast_path import CRC_EXTRA
from mavbridge.mavlink.codec.frames import RawPacket, frame_at
from mavbridge.mavlink.codec.messages import Endpoint

STAMP_BYTES = 8
"""Big-endian, unsigned."""
_LATEST_US = 1 << 52
"""Unix time of the year 2112: no stamp is later."""
_NEAR_US, _DAY_US = 1_000_000, 86_400_000_000
_LOOK_AHEAD = 8
"""Records of unknown messages in a row, after which they are taken for records."""
_MARKER = re.compile(rb"[\xfd\xfe]")
_MIRRORED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))


@dataclass
class Skipped:
    """Damage that ``read_tlog`` has passed over."""

    bytes: int = 0
    """Those that belong to no packet; not the padding of records of a fixed size."""
    packets: int = 0
    """By the gaps in the senders' sequence numbers; at least one at either end of the log."""

    def describe(self, path: Path) -> str | None:
        """Return a sentence for the user; None if nothing was skipped."""
        if not self.bytes:
            return None
        return (
            f"{path} is damaged, or of another MAVLink dialect: {self.bytes} bytes were skipped, "
            f"with {self.packets} packets"
        )


class _Record(NamedTuple):
    at: int
    end: int
    stamp_us: int
    packet: RawPacket


def read_tlog(path: Path, skipped: Skipped | None = None) -> Iterator[tuple[int, RawPacket]]:
    """Unix time in microseconds and packet of each record.

    Reads on behind damage, which it counts in ``skipped``: a packet counts only if its checksum
    fits, and where its stamp does not belong between those around it, it is damaged as well.
    Packets of unknown messages have no checksum to try: they count where they go on from the last
    one of their sender, or another record follows, and none begins inside them.

    Raises:
        UserError: the log cannot be read.
    """
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size:
                with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                    yield from _Records(data, Skipped() if skipped is None else skipped)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


class _Records:
    """One pass over a log in memory."""

    def __init__(self, data: mmap.mmap, skipped: Skipped) -> None:
        self._data = data
        self._skipped = skipped
        self._period = 0
        """Size that all records are padded to; 0 = to none."""
        self._last_us: int | None = None
        self._sequences: dict[Endpoint, int] = {}

    def __iter__(self) -> Iterator[tuple[int, RawPacket]]:
        start = at = 0
        unsure: set[Endpoint] = set()
        """Senders that were not heard since the last damage."""
        while at < len(self._data):
            due = start + self._period if self._period else at
            record = self._expected(at) or self._expected(due)
            if record is None:
                record = self._search(at, len(self._data))
                if record is None:
                    if (left := len(self._data) - due) > 0:
                        self._skipped.bytes += left
                        self._skipped.packets += 1
                    return
                if self._is_padded(record, record.at - start):
                    self._period = record.at - start
                else:
                    self._skipped.bytes += record.at - due
                    self._skipped.packets += not self._sequences
                    unsure = set(self._sequences)
            start, at, self._last_us, packet = record
            if packet.source in unsure:
                unsure.remove(packet.source)
                self._skipped.packets += (packet.sequence - self._next(packet)) % 256
            self._sequences[packet.source] = packet.sequence
            yield record.stamp_us, packet

    def _next(self, packet: RawPacket) -> int:
        """Return the number that the sender's next packet has, or -1."""
        last = self._sequences.get(packet.source)
        return -1 if last is None else (last + 1) % 256

    def _search(self, at: int, end: int) -> _Record | None:
        """Return the first record that begins behind this place and whose checksum fits."""
        for marker in _MARKER.finditer(self._data, at + 1 + STAMP_BYTES, end + STAMP_BYTES):
            record = self._sound(marker.start() - STAMP_BYTES)
            if record is not None and self._goes_on(record):
                return record
        return None

    def _expected(self, at: int) -> _Record | None:
        """Return the record that begins here; one of an unknown message has no checksum to try."""
        record = self._sound(at)
        if record is None and (found := self._framed(at)) and _extra(found) is None:
            is_next = self._next(found.packet) == found.packet.sequence
            is_record = is_next or self._is_followed(found)
            record = found if is_record and self._search(at, found.end) is None else None
        return record if record is not None and self._goes_on(record) else None

    def _is_followed(self, record: _Record) -> bool:
        for _ in range(_LOOK_AHEAD):
            if record.end == len(self._data):
                return True
            after = self._framed(record.end)
            if after is None or _extra(after) is not None:
                return self._sound(record.end) is not None
            record = after
        return True

    def _goes_on(self, record: _Record) -> bool:
        """Return whether a stamp fits between the last one and the next two; one may be wrong.

        A clock that jumps stays there, and a link may be silent for long.
        """
        last_us, stamp_us = self._last_us, record.stamp_us
        if last_us is not None and _are_near(stamp_us, last_us):
            return True
        later_us: list[int] = []
        after: _Record | None = record
        while len(later_us) < 2 and after is not None:
            padded = self._sound(after.at + self._period) if self._period else None
            if (after := self._sound(after.end) or padded) is not None:
                later_us.append(after.stamp_us)
        if any(_are_near(us, stamp_us) for us in later_us):
            return True
        if last_us is None:
            return len(later_us) < 2 or stamp_us <= later_us[0] or not _are_near(*later_us)
        if any(_are_near(us, last_us) for us in later_us):
            return False
        return last_us <= stamp_us <= max(later_us, default=last_us + _DAY_US)

    def _is_padded(self, second: _Record, size: int) -> bool:
        """Return whether the second record and the next two lie ``size`` bytes apart."""
        places = [second.at + size, second.at + 2 * size]
        known = [found for place in places if (found := self._sound(place))]
        return (
            second.at == size
            and len(known) == min(2, max(1, len(self._data) // size - 2))
            and not any(self._sound(each.end) for each in (second, *known))
        )

    def _sound(self, at: int) -> _Record | None:
        """Return the record at this place if its packet is whole and its checksum fits."""
        record = self._framed(at)
        if record is None or (extra := _extra(record)) is None:
            return None
        body, checksum = record.packet.sealed
        crc = crc_hqx((body + bytes((extra,))).translate(_MIRRORED), 0xFFFF)
        return record if checksum == crc.to_bytes(2, "big").translate(_MIRRORED) else None

    def _framed(self, at: int) -> _Record | None:
        packet = frame_at(self._data, at + STAMP_BYTES)
        stamp_us = int.from_bytes(self._data[at : at + STAMP_BYTES], "big")
        if packet is None or stamp_us > _LATEST_US:
            return None
        return _Record(at, at + STAMP_BYTES + len(packet.data), stamp_us, packet)


def _extra(record: _Record) -> int | None:
    return CRC_EXTRA.get(record.packet.message_id)


def _are_near(one_us: int, other_us: int) -> bool:
    return abs(one_us - other_us) <= _NEAR_US
