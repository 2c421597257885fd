"""Frames from the output of a camera program: JPEG or PNG, or raw pictures of one size."""

import re
import struct
from abc import ABC, abstractmethod
from typing import NamedTuple

import cv2
import numpy as np

from mavbridge.core.errors import CameraError
from mavbridge.core.records import CameraImage

MAX_JPEG_BYTES = 16 << 20
MAX_BETWEEN_BYTES = 4096
"""Limit for the multipart headers between two pictures [bytes]."""
MAX_SIDE_PX = 8192
MAX_BAD_FRAMES = 10
"""Limit of consecutive frames that cannot be decoded."""
_SOI, _EOI, _SOS, _FILL = b"\xff\xd8", 0xD9, 0xDA, 0xFF
_SOF = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
"""Markers of the segment that contains a JPEG's size."""
_SIDES = struct.Struct(">HH")
_PNG = b"\x89PNG\r\n\x1a\n"
_IHDR = struct.Struct(">16xIIBB")
"""Width, height, bits per sample and colour type (0: grey) of a PNG."""
_START = re.compile(re.escape(_SOI) + b"|" + re.escape(_PNG))
_MARKER = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
"""Marker in a scan's coded data, where 00 and the restart markers D0 to D7 are data."""


class DamageCount:
    """Number of consecutive frames of one source that could not be decoded."""

    def __init__(self, name: str, frames: str = "pictures") -> None:
        """``name`` is the source's name in messages, ``frames`` that of its frames."""
        self._name, self._frames, self._count = name, frames, 0

    def note(self, rgb: CameraImage | None) -> None:
        """Count a frame, None if damaged. Raises CameraError after ``MAX_BAD_FRAMES`` in a row."""
        self._count = self._count + 1 if rgb is None else 0
        if self._count > MAX_BAD_FRAMES:
            raise CameraError(f"{self._name}: {self._count} {self._frames} in a row are damaged")


class RawFormat(NamedTuple):
    """Memory layout of a raw picture."""

    bits: int
    """Bits per pixel."""
    conversion: int | None
    """OpenCV's code of the conversion to RGB; None: already RGB, or depth (``is_depth``)."""
    is_depth: bool = False
    """True: one little-endian number per pixel."""


RAW_FORMATS = {
    "rgb24": RawFormat(24, None),
    "bgr24": RawFormat(24, cv2.COLOR_BGR2RGB),
    "gray": RawFormat(8, cv2.COLOR_GRAY2RGB),
    "yuv420p": RawFormat(12, cv2.COLOR_YUV2RGB_I420),
    "nv12": RawFormat(12, cv2.COLOR_YUV2RGB_NV12),
    "yuyv422": RawFormat(16, cv2.COLOR_YUV2RGB_YUY2),
    "gray16le": RawFormat(16, None, is_depth=True),
}
"""Raw formats by FFmpeg's names."""


def decode_picture(data: bytes) -> CameraImage | None:
    """Decode a JPEG or PNG to [H, W, 3] uint8 RGB, or a 16-bit grey PNG to [H, W] uint16.

    Return None if it is damaged or larger than MAX_SIDE_PX per side, which is checked first.
    """
    is_png = data.startswith(_PNG) and len(data) > _IHDR.size
    sides = _IHDR.unpack_from(data)[:2] if is_png else _jpeg_sides(data)
    if not 0 < min(sides) <= max(sides) <= MAX_SIDE_PX:
        return None
    is_depth = is_png and _IHDR.unpack_from(data)[2:] == (16, 0)
    flag = cv2.IMREAD_UNCHANGED if is_depth else cv2.IMREAD_COLOR
    pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flag)
    if pixels is None:
        return None
    if is_depth:
        return np.asarray(pixels, dtype=np.uint16)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def _jpeg_sides(data: bytes) -> tuple[int, int]:
    """Return height and width from the first segment that contains them, or zeros."""
    at = len(_SOI)
    while data.startswith(_SOI) and at + 9 <= len(data) and data[at] == _FILL:
        if data[at + 1] in _SOF:
            return _SIDES.unpack_from(data, at + 5)
        is_fill = data[at + 1] == _FILL
        at += 1 if is_fill else 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return 0, 0


class FrameCutter(ABC):
    """Consumes a byte stream, and provides the newest whole frame."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._newest: tuple[bytes, int] | None = None
        self._first_ns = 0
        """Arrival of the first byte of the incomplete frame."""

    def take(self) -> tuple[bytes, int] | None:
        """Return the newest whole frame and the arrival of its first byte, or None."""
        newest, self._newest = self._newest, None
        return newest

    def put(self, data: bytes, arrived_ns: int) -> None:
        """Take bytes. Raises CameraError if they cannot be frames."""
        if not self._buffer:
            self._first_ns = arrived_ns
        self._buffer += data
        while (end := self._find_end(arrived_ns)) is not None:
            self._newest = bytes(self._buffer[:end]), self._first_ns
            del self._buffer[:end]
            self._first_ns = arrived_ns

    @abstractmethod
    def _find_end(self, arrived_ns: int) -> int | None:
        """Move the first frame to the front; return its length, or None if it is incomplete."""

    @abstractmethod
    def decode(self, frame: bytes) -> CameraImage | None:
        """Return [H, W, 3] uint8 RGB or [H, W] uint16 depth; None if the frame is damaged."""

    @abstractmethod
    def rest(self) -> str:
        """Describe the unused bytes at the end of the stream."""


class RawCutter(FrameCutter):
    """Cutter for consecutive raw pictures of one size, any bytes of which are valid."""

    def __init__(self, width: int, height: int, pixels: RawFormat) -> None:
        super().__init__()
        self._shape = (height, width)
        self._format = pixels
        self._size = width * height * pixels.bits // 8

    def _find_end(self, arrived_ns: int) -> int | None:
        return self._size if len(self._buffer) >= self._size else None

    def decode(self, frame: bytes) -> CameraImage:
        """See `FrameCutter`."""
        height, width = self._shape
        if self._format.is_depth:
            return np.frombuffer(frame, "<u2").reshape(height, width).astype(np.uint16)
        array = np.frombuffer(frame, np.uint8)
        conversion = self._format.conversion
        if conversion is None:
            return array.reshape(height, width, 3).copy()
        rows = {8: (height, width), 12: (height * 3 // 2, width), 16: (height, width, 2)}
        shaped = array.reshape(rows.get(self._format.bits, (height, width, 3)))
        return np.asarray(cv2.cvtColor(shaped, conversion), dtype=np.uint8)

    def rest(self) -> str:
        """See `FrameCutter`."""
        if not self._buffer:
            return ""
        height, width = self._shape
        return (
            f"; its last {len(self._buffer)} bytes are no whole picture of {self._size} bytes: is "
            f"{width}x{height} right, and the format?"
        )


class PictureCutter(FrameCutter):
    """Cutter for consecutive JPEG or PNG pictures, with or without multipart headers."""

    def __init__(self) -> None:
        super().__init__()
        self._at = 0
        """Position at which the search continues; 0 until a picture's start is found."""
        self._in_scan = self._is_png = self._has_found = False
        self._damaged = 0
        """Consecutive pictures that were dropped because they were damaged."""

    def _find_end(self, arrived_ns: int) -> int | None:
        while self._at or self._find_start(arrived_ns):
            if self._find_png_end() if self._is_png else self._find_jpeg_end(arrived_ns):
                end, self._at, self._in_scan = self._at, 0, False
                self._has_found, self._damaged = True, 0
                return end
            if self._at:
                if len(self._buffer) > MAX_JPEG_BYTES:
                    raise CameraError(f"no picture ended within {MAX_JPEG_BYTES >> 20} MiB")
                return None
        return None

    def _find_start(self, arrived_ns: int) -> bool:
        start = _START.search(self._buffer)
        if start is None:
            if self._has_found:  # the rest of a damaged picture, or padding
                del self._buffer[: -len(_PNG)]
            elif len(self._buffer) > MAX_BETWEEN_BYTES:
                begin = bytes(self._buffer[:8]).hex(" ")
                raise CameraError(
                    f"its output is no MJPEG and no PNG: it begins with {begin}; for raw pictures "
                    "write pipe:WIDTHxHEIGHT:FORMAT:COMMAND"
                )
            return False
        self._at, self._first_ns = len(start[0]), arrived_ns
        self._is_png = start[0] == _PNG
        del self._buffer[: start.start()]
        return True

    def _find_jpeg_end(self, arrived_ns: int) -> bool:
        """Walk over the segments of the picture. Return True if it ends at ``_at``.

        If another picture starts before, the first was cut off, and is dropped. If it is damaged,
        its start is dropped, and ``_at`` becomes 0.
        """
        buffer = self._buffer
        while True:
            if self._in_scan:
                match = _MARKER.search(buffer, self._at)
                if match is None:
                    self._at = max(self._at, len(buffer) - 1)
                    return False
                self._at, self._in_scan = match.start(), False
            if len(buffer) < self._at + 2:
                return False
            marker = buffer[self._at + 1]
            if buffer[self._at] != 0xFF:
                return self._drop_damaged()
            if marker == _EOI:
                self._at += 2
                return True
            if marker == _SOI[1]:
                del buffer[: self._at]
                self._at, self._first_ns = len(_SOI), arrived_ns
                continue
            if marker == _FILL:
                self._at += 1
                continue
            length = int.from_bytes(buffer[self._at + 2 : self._at + 4], "big")
            if len(buffer) < self._at + 2 + max(length, 2):
                return False
            self._at += 2 + length
            self._in_scan = marker == _SOS

    def _drop_damaged(self) -> bool:
        """Drop the start of a damaged picture, so that the next one is searched for."""
        self._damaged += 1
        if self._damaged > MAX_BAD_FRAMES:
            raise CameraError("its output is no MJPEG, or a damaged one")
        del self._buffer[: len(_SOI)]
        self._at = 0
        return False

    def _find_png_end(self) -> bool:
        """Walk over the chunks of the picture. Return True if it ends at ``_at``."""
        buffer, kind = self._buffer, b""
        while kind != b"IEND":
            kind = bytes(buffer[self._at + 4 : self._at + 8])
            end = self._at + 12 + int.from_bytes(buffer[self._at : self._at + 4], "big")
            if len(kind) < 4 or end > len(buffer):
                return False
            self._at = end
        return True

    def decode(self, frame: bytes) -> CameraImage | None:
        """See `FrameCutter`."""
        return decode_picture(frame)

    def rest(self) -> str:
        """See `FrameCutter`."""
        return "; its last picture was cut off" if self._buffer else ""
