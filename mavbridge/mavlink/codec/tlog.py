"""Reads telemetry logs of any ground station: 8 bytes of Unix time in us before each packet."""

from collections.abc import Iterator
from pathlib import Path

from mavbridge.core.errors import UserError
from mavbridge.mavlink.codec.frames import RawPacket, frame_at

STAMP_BYTES = 8
"""Big-endian, unsigned."""
_BLOCK_BYTES = 1 << 20
_MOST_BYTES = STAMP_BYTES + 300
"""Size of one record: a MAVLink packet has at most 280 bytes."""


def read_tlog(path: Path) -> Iterator[tuple[int, RawPacket]]:
    """Unix time in microseconds and packet of each record, up to the first that is cut off.

    One block of the file is in memory at a time.

    Raises:
        UserError: the log cannot be read.
    """
    try:
        with path.open("rb") as file:
            data, at, is_end = b"", 0, False
            while True:
                if not is_end and len(data) - at < _MOST_BYTES:
                    block = file.read(_BLOCK_BYTES)
                    data, at, is_end = data[at:] + block, 0, not block
                packet = frame_at(data, at + STAMP_BYTES)
                if packet is None:
                    return
                yield int.from_bytes(data[at : at + STAMP_BYTES], "big"), packet
                at += STAMP_BYTES + len(packet.data)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
