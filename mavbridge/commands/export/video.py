"""Videos that hold many episodes one after the other, in files of a limited size.

LeRobot's reader wants frame k of an episode at ``from_timestamp + k / fps``, within 0.1 ms
(lerobot 0.6.1, ``datasets/lerobot_dataset.py`` ``tolerance_s``, ``datasets/video_utils.py``), so a
file has one frame every 1/fps exactly, from 0 on.
"""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
from av.container import OutputContainer
from av.video.stream import VideoStream

from mavbridge.core.records import ImageArray
from policy.data import lerobot_format as names

FILES_A_CHUNK = 1000
"""LeRobot's ``DEFAULT_CHUNK_SIZE``."""
MAX_FILE_S = 1000.0
"""The reader compares times as float32, whose step is above 0.1 ms from 1024 s on."""
_OPTIONS = {
    "preset": "veryfast",
    "crf": "20",  # as the recorder's
    "g": "2",  # LeRobot's own: any frame is to be had for two decoded
    "tune": "zerolatency",  # a frame in, a packet out; none is before time 0
    "threads": "1",
}


@dataclass(frozen=True, kw_only=True)
class VideoSpan:
    """Where the frames of an episode are."""

    chunk_index: int
    file_index: int
    from_s: float
    to_s: float


class VideoFiles:
    """Encodes episodes one after the other, H.264, yuv420p."""

    def __init__(
        self, folder: Path, *, fps: int, height: int, width: int, limit_bytes: int
    ) -> None:
        """Nothing is written yet.

        Args:
            folder: the dataset.
            fps: frames a second of all files.
            height: of the frames, even.
            width: of the frames, even.
            limit_bytes: of a file; one episode alone may be larger.
        """
        self._folder = folder
        self._fps = fps
        self._size = (height, width)
        self._limit_bytes = limit_bytes
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._file = -1
        self._frames = 0
        """In the file."""
        self._first = 0
        """Of them, the first of the episode."""
        self._bytes = 0
        self._all_frames, self._all_bytes = 0, 0

    def begin(self, frames: int) -> None:
        """Begin an episode of so many frames, in a new file where this one would grow too large.

        Raises:
            OSError, FFmpegError: it cannot be written.
        """
        expected = self._bytes + frames * self._all_bytes / max(self._all_frames, 1)
        is_full = expected >= self._limit_bytes or self._frames + frames > MAX_FILE_S * self._fps
        if self._container is None or (is_full and self._frames > 0):
            self._next_file()
        self._first = self._frames

    def append(self, rgb: ImageArray) -> None:
        """Encode a frame [H, W, 3] uint8.

        Raises:
            OSError, FFmpegError: it cannot be written.
        """
        if self._stream is None:
            raise ValueError("begin an episode first")
        frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
        frame.pts, frame.time_base = self._frames, Fraction(1, self._fps)
        if self._frames == self._first:
            frame.pict_type = av.video.frame.PictureType.I  # an episode is decoded by itself
        self._mux(frame)
        self._frames += 1
        self._all_frames += 1

    def end(self) -> VideoSpan:
        """Where the episode went."""
        return VideoSpan(
            chunk_index=self._file // FILES_A_CHUNK,
            file_index=self._file % FILES_A_CHUNK,
            from_s=self._first / self._fps,
            to_s=self._frames / self._fps,
        )

    def close(self) -> None:
        """Finish the file.

        Raises:
            OSError, FFmpegError: it cannot be written.
        """
        if self._container is not None:
            try:
                self._mux(None)
            finally:
                self._container.close()
                self._container = self._stream = None

    def _next_file(self) -> None:
        self.close()
        self._file += 1
        self._frames = self._bytes = 0
        chunk, file = divmod(self._file, FILES_A_CHUNK)
        path = self._folder / names.VIDEO.format(
            video_key=names.CAMERA_KEY, chunk_index=chunk, file_index=file
        )
        path.parent.mkdir(parents=True, exist_ok=True)
        self._container = av.open(str(path), "w", options={"movflags": "faststart"})
        stream = self._container.add_stream("libx264", self._fps)
        stream.height, stream.width = self._size
        stream.pix_fmt, stream.options = "yuv420p", dict(_OPTIONS)
        stream.codec_context.time_base = Fraction(1, self._fps)
        self._stream = stream

    def _mux(self, frame: av.VideoFrame | None) -> None:
        if self._container is None or self._stream is None:
            raise ValueError("no file is open")
        packets = self._stream.encode(frame)
        size = sum(packet.size for packet in packets)
        self._bytes += size
        self._all_bytes += size
        self._container.mux(packets)
