"""H.264 in fragmented MP4, one fragment a frame: what has been appended stays readable.

Depth images are kept as they are, in FFV1: 16 bits, without loss.

Layout: ISO/IEC 14496-12. A moov box without samples, then a moof and an mdat box for each frame.
The muxer holds a frame back until the next one gives its duration, so a file that was cut off
lacks at most its last frame.
"""

import mmap
from collections.abc import Iterator
from fractions import Fraction
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np
from av.container import OutputContainer
from av.error import FFmpegError

from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import CameraImage

CRF = "20"
"""Constant quality; 17 to 18 is taken for visually lossless, 23 is x264's default."""
GOP_FRAMES = 30
"""A second between key frames."""
TIME_BASE = Fraction(1, 90_000)
"""Usual time base of video; the exact stamps are in the table."""
_OPTIONS: dict[str, object] = {
    "preset": "veryfast",
    "tune": "zerolatency",  # a frame in, a packet out
    "crf": CRF,
    "threads": "1",
    "g": str(GOP_FRAMES),
}
_DEPTH = "gray16le"
_FRAGMENTED = {"movflags": "frag_every_frame+empty_moov+default_base_moof"}
WRITE_ERRORS = (OSError, FFmpegError)
_BOX_HEADER_BYTES = 8
_BUFFER_BYTES = 1 << 20
"""More than a fragment: it is written in one call, which a kill cannot tear."""


class VideoError(MavbridgeError):
    """A video that cannot be read."""


class FragmentedMp4:
    """A video file that grows by a frame at a time; methods may raise ``WRITE_ERRORS``."""

    def __init__(
        self, path: Path, *, height: int, width: int, hz: float, is_depth: bool = False
    ) -> None:
        """Create the file, which must not exist, for frames with even sides.

        ``hz`` is the nominal frame rate; the frames' own stamps decide.
        """
        self._file: BinaryIO = path.open("xb", buffering=_BUFFER_BYTES)
        self._container: OutputContainer = av.open(
            self._file, "w", format="mp4", options=_FRAGMENTED
        )
        rate = Fraction(hz).limit_denominator(1000)
        if is_depth:
            stream = self._container.add_stream("ffv1", rate)
        else:
            stream = self._container.add_stream("libx264", rate)
            stream.options = _OPTIONS
        stream.height, stream.width = height, width
        stream.pix_fmt = _DEPTH if is_depth else "yuv420p"
        stream.codec_context.time_base = TIME_BASE
        self._stream = stream
        self._first_ns: int | None = None
        self._last_pts = -1

    def append(self, rgb: CameraImage, captured_ns: int) -> None:
        """Encode one frame and hand it to the kernel.

        A stamp that is not after the last frame's is moved behind it.
        """
        if self._first_ns is None:
            self._first_ns = captured_ns
        pts = max(self._last_pts + 1, (captured_ns - self._first_ns) * 9 // 100_000)
        pixels: Any = rgb
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24" if rgb.ndim == 3 else _DEPTH)
        frame.pts, frame.time_base = pts, TIME_BASE
        self._container.mux(self._stream.encode(frame))
        self._file.flush()
        self._last_pts = pts

    def close(self) -> None:
        """Write what is left and close the file, also after an error."""
        try:
            self._container.mux(self._stream.encode(None))
            self._container.close()
        finally:
            self._file.close()


def count_frames(path: Path) -> int:
    """Whole frames of a file of ``FragmentedMp4``, however it ended; raises VideoError."""
    try:
        return len(_frame_ends(path))
    except OSError as error:
        raise VideoError(f"{path} cannot be read: {error.strerror}") from error


def _frame_ends(path: Path) -> list[int]:
    """Offsets in the file, in bytes, at which its whole frames end."""
    ends, at, size_bytes = [], 0, path.stat().st_size
    with path.open("rb") as file:
        while at + _BOX_HEADER_BYTES <= size_bytes:
            header = file.read(_BOX_HEADER_BYTES)
            size = int.from_bytes(header[:4], "big")
            at += size
            if size < _BOX_HEADER_BYTES or at > size_bytes:
                break  # cut off; a 64-bit or open-ended box is never written here
            if header[4:] == b"mdat":
                ends.append(at)
            file.seek(at)
    return ends


def read_video(path: Path, frames: int | None = None) -> Iterator[CameraImage]:
    """Frames of a file of ``FragmentedMp4``, whole or cut off, as they were appended.

    ``frames`` is the number to read, by default all whole ones. Raises VideoError if the file
    cannot be read, or ends before that.
    """
    wanted = count_frames(path) if frames is None else frames
    if wanted == 0:
        return
    seen = 0
    try:
        # Mapped up to the last whole frame, since demuxers stumble over a torn box.
        end = max(_frame_ends(path), default=0)
        with (
            path.open("rb") as file,
            mmap.mmap(file.fileno(), end, access=mmap.ACCESS_READ) as whole,
            av.open(whole, "r", format="mp4") as container,
        ):
            for frame in islice(container.decode(video=0), wanted):
                if frame.format.name == _DEPTH:
                    yield frame.to_ndarray().astype(np.uint16, copy=False)
                else:
                    yield frame.to_ndarray(format="rgb24").astype(np.uint8, copy=False)
                seen += 1
    except (OSError, ValueError, FFmpegError) as error:  # ValueError: the file is empty
        raise VideoError(f"{path} cannot be decoded after {seen} frames: {error}") from error
    if seen < wanted:
        raise VideoError(f"{path} ends after {seen} of {wanted} frames: it was damaged later")
