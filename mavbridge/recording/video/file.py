"""H.264 in fragmented MP4, one fragment a frame: what has been appended stays readable.

Layout: ISO/IEC 14496-12. A moov box without samples, then a moof and an mdat box for each frame.
The muxer holds a frame back until the next one tells its duration, so a file that was cut off
lacks at most its last frame.
"""

import os
from collections.abc import Iterator
from fractions import Fraction
from io import RawIOBase
from itertools import islice
from pathlib import Path
from typing import BinaryIO

import av
import numpy as np
from av.container import OutputContainer
from av.error import FFmpegError

from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import ImageArray

CRF = "20"
"""Constant quality; 17 to 18 is taken for visually lossless, 23 is x264's default."""
GOP_FRAMES = 30
"""A second between key frames."""
TIME_BASE = Fraction(1, 90_000)
"""What players expect of video; the exact stamps are in the table."""
_OPTIONS: dict[str, object] = {
    "preset": "veryfast",
    "tune": "zerolatency",  # a frame in, a packet out
    "crf": CRF,
    "threads": "1",
    "g": str(GOP_FRAMES),
}
_FRAGMENTED = {"movflags": "frag_every_frame+empty_moov+default_base_moof"}
_BOX_HEADER_BYTES = 8
_BUFFER_BYTES = 1 << 20
"""More than a fragment: it goes out in one piece, which a kill cannot tear."""


class VideoError(MavbridgeError):
    """A video that cannot be read."""


class FragmentedMp4:
    """A video file that grows by a frame at a time."""

    def __init__(self, path: Path, *, height: int, width: int, hz: float) -> None:
        """Create the file.

        Args:
            path: must not exist.
            height: of every frame; even.
            width: of every frame; even.
            hz: nominal frame rate; the frames' own stamps decide.

        Raises:
            OSError: it exists, or cannot be written.
        """
        self._file: BinaryIO = path.open("xb", buffering=_BUFFER_BYTES)
        self._container: OutputContainer = av.open(
            self._file, "w", format="mp4", options=_FRAGMENTED
        )
        stream = self._container.add_stream("libx264", Fraction(hz).limit_denominator(1000))
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        stream.options = _OPTIONS
        stream.codec_context.time_base = TIME_BASE
        self._stream = stream
        self._first_ns: int | None = None
        self._last_pts = -1
        self.frames = 0

    def append(self, rgb: ImageArray, captured_ns: int) -> None:
        """Encode one frame and hand it to the kernel.

        Args:
            rgb: [H, W, 3] uint8.
            captured_ns: its place in time; one that is not after the last is moved behind it.

        Raises:
            OSError, FFmpegError: it cannot be written.
        """
        if self._first_ns is None:
            self._first_ns = captured_ns
        pts = max(self._last_pts + 1, (captured_ns - self._first_ns) * 9 // 100_000)
        frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
        frame.pts, frame.time_base = pts, TIME_BASE
        self._container.mux(self._stream.encode(frame))
        self._file.flush()
        self._last_pts = pts
        self.frames += 1

    def close(self) -> None:
        """Write what is left and close the file, also after an error.

        Raises:
            OSError, FFmpegError: it cannot be written.
        """
        try:
            self._container.mux(self._stream.encode(None))
            self._container.close()
        finally:
            self._file.close()


WRITE_ERRORS = (OSError, FFmpegError)
"""What ``FragmentedMp4`` raises."""


def count_frames(path: Path) -> int:
    """Whole frames of a file of ``FragmentedMp4``, however it ended.

    Raises:
        VideoError: it cannot be read.
    """
    try:
        return sum(kind == b"mdat" for kind, _ in _whole_boxes(path))
    except OSError as error:
        raise VideoError(f"{path} cannot be read: {error.strerror}") from error


def _whole_boxes(path: Path) -> Iterator[tuple[bytes, int]]:
    """Type and end of the boxes in their order, up to the first that is cut off."""
    at, size_bytes = 0, path.stat().st_size
    with path.open("rb") as file:
        while at + _BOX_HEADER_BYTES <= size_bytes:
            header = file.read(_BOX_HEADER_BYTES)
            size = int.from_bytes(header[:4], "big")
            at += size
            if size < _BOX_HEADER_BYTES or at > size_bytes:
                return  # cut off; a 64-bit or open-ended box is never written here
            yield header[4:], at
            file.seek(at)


class _Beginning(RawIOBase):
    """A file that ends where its whole frames do: demuxers stumble over a torn box."""

    def __init__(self, path: Path, end: int) -> None:
        self._file = path.open("rb")
        self._end = end

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._file.tell()

    def seek(self, offset: int, whence: int = 0) -> int:
        if whence == os.SEEK_END:
            offset, whence = self._end + offset, os.SEEK_SET
        return self._file.seek(offset, whence)

    def read(self, size: int = -1) -> bytes:
        left = max(0, self._end - self._file.tell())
        return self._file.read(left if size < 0 else min(size, left))

    def close(self) -> None:
        self._file.close()
        super().close()


def read_video(path: Path, frames: int | None = None) -> Iterator[ImageArray]:
    """Frames of a file of ``FragmentedMp4`` in their order, [H, W, 3] uint8 RGB.

    Args:
        path: the file, whole or cut off.
        frames: how many to read; by default all whole ones.

    Raises:
        VideoError: it cannot be read, or ends before that.
    """
    wanted = count_frames(path) if frames is None else frames
    if wanted == 0:
        return
    seen = 0
    try:
        end = max((end for kind, end in _whole_boxes(path) if kind == b"mdat"), default=0)
        with _Beginning(path, end) as file, av.open(file, "r") as container:
            for frame in islice(container.decode(video=0), wanted):
                yield frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False)
                seen += 1
    except (OSError, FFmpegError) as error:
        raise VideoError(f"{path} cannot be decoded after {seen} frames: {error}") from error
    if seen < wanted:
        raise VideoError(f"{path} ends after {seen} of {wanted} frames: it was damaged later")
