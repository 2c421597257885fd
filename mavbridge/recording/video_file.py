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

    def __init__(self, path: Path, hz: float) -> None:
        """Write to ``path``, created with the first frame, which gives the size and the kind.

        ``hz`` is the nominal frame rate; the stamps of the frames decide.
        """
        self._path, self._hz = path, hz
        self._file: BinaryIO | None = None
        self._first_ns: int | None = None
        self._last_pts = -1

    def _open(self, image: CameraImage) -> BinaryIO:
        self._file = file = self._path.open("xb", buffering=_BUFFER_BYTES)
        self._container: OutputContainer = av.open(file, "w", format="mp4", options=_FRAGMENTED)
        rate = Fraction(self._hz).limit_denominator(1000)
        if image.ndim == 2:  # depth
            self._stream = self._container.add_stream("ffv1", rate)
            self._stream.options = {"g": "1"}  # each image separately
        else:
            self._stream = self._container.add_stream("libx264", rate)
            self._stream.options = _OPTIONS
        self._stream.height, self._stream.width = image.shape[:2]
        self._stream.pix_fmt = _DEPTH if image.ndim == 2 else "yuv420p"
        self._stream.codec_context.time_base = TIME_BASE
        return file

    def append(self, image: CameraImage, captured_ns: int) -> None:
        """Encode one frame with even sides and hand it to the kernel.

        A stamp not later than the last frame's is moved behind it.
        """
        file = self._file or self._open(image)
        if self._first_ns is None:
            self._first_ns = captured_ns
        pts = max(self._last_pts + 1, (captured_ns - self._first_ns) * 9 // 100_000)
        pixels: Any = image
        frame = av.VideoFrame.from_ndarray(pixels, format="rgb24" if image.ndim == 3 else _DEPTH)
        frame.pts, frame.time_base = pts, TIME_BASE
        self._container.mux(self._stream.encode(frame))
        file.flush()
        self._last_pts = pts

    def close(self) -> None:
        """Write the remaining data and close the file, also after an error. Can be called twice."""
        file, self._file = self._file, None
        if file is None:
            return
        try:
            self._container.mux(self._stream.encode(None))
            self._container.close()
        finally:
            file.close()
