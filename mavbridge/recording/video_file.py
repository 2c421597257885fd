"""H.264 in fragmented MP4, one fragment per frame, so that appended frames stay readable.

Depth images are kept losslessly in 16 bits (FFV1).

The muxer holds a frame back until the next one gives its duration, so a cut-off file lacks at most
its last frame.
"""

from fractions import Fraction
from pathlib import Path
from typing import Any, BinaryIO

import av
from av.container import OutputContainer
from av.error import FFmpegError

from mavbridge.core.records import CameraImage

CRF = "20"
"""Constant quality. 17 to 18 counts as visually lossless; 23 is x264's default."""
GOP_FRAMES = 30
"""One second between key frames."""
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
_BUFFER_BYTES = 1 << 20
"""Larger than a fragment, which is therefore written in one call that a kill cannot tear."""


class FragmentedMp4:
    """Video file that grows frame by frame. Methods can raise ``WRITE_ERRORS``."""

    def __init__(
        self, path: Path, *, height: int, width: int, hz: float, is_depth: bool = False
    ) -> None:
        """Create the file, which must not exist, for frames with even sides.

        ``hz`` is the nominal frame rate; the stamps of the frames decide.
        """
        self._file: BinaryIO = path.open("xb", buffering=_BUFFER_BYTES)
        self._container: OutputContainer = av.open(
            self._file, "w", format="mp4", options=_FRAGMENTED
        )
        rate = Fraction(hz).limit_denominator(1000)
        if is_depth:
            stream = self._container.add_stream("ffv1", rate)
            stream.options = {"g": "1"}  # each image separately
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

        A stamp not later than the last frame's is moved behind it.
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
        """Write the remaining data and close the file, also after an error."""
        try:
            self._container.mux(self._stream.encode(None))
            self._container.close()
        finally:
            self._file.close()
