"""Videos and tables that hold many episodes one after the other, in files of a limited size.

LeRobot's reader wants frame k of an episode at ``from_timestamp + k / fps``, within 0.1 ms
(lerobot 0.6.1, ``datasets/lerobot_dataset.py`` ``tolerance_s``, ``datasets/video_utils.py``), so a
video has one frame every 1/fps exactly, from 0 on.
"""

from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from av.container import OutputContainer
from av.video.stream import VideoStream
from numpy.typing import NDArray

from mavbridge.core.records import ImageArray
from policy.contract import STATE_NAMES, StateFrame
from policy.data import lerobot_format as names
from policy.files import library_name

MB = 1024**2
DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
"""LeRobot's defaults (``datasets/utils.py``)."""
FILES_A_CHUNK = 1000
"""LeRobot's ``DEFAULT_CHUNK_SIZE``."""
MAX_FILE_S = 1000.0
"""The reader compares times as float32, whose step is above 0.1 ms from 1024 s on."""
_OPTIONS: dict[str, object] = {
    "preset": "veryfast",
    "crf": "20",  # as the recorder's
    "g": "2",  # LeRobot's own: any frame is had by decoding two
    "tune": "zerolatency",  # a frame in, a packet out; none is before time 0
    "threads": "1",
}


class VideoSpan(NamedTuple):
    """Place of the frames of an episode."""

    chunk_index: int
    file_index: int
    from_s: float
    to_s: float


@dataclass(frozen=True, kw_only=True)
class DatasetSpec:
    """Properties that all episodes share."""

    fps: int
    height: int
    """Size of the images, even, as ``width``."""
    width: int
    state_frame: StateFrame
    task: str
    state_names: tuple[str, ...] = STATE_NAMES
    """Numbers of ``observation.state``: the contract's, or made of them by ``adapters.state``."""
    data_file_bytes: int = DATA_FILE_MB * MB
    video_file_bytes: int = VIDEO_FILE_MB * MB
    """Size of a file; one episode alone may be larger."""


class VideoFiles:
    """Encodes episodes one after the other, H.264, yuv420p.

    Methods raise OSError or FFmpegError where a file cannot be written.
    """

    def __init__(self, folder: Path, spec: DatasetSpec) -> None:
        """Prepare; nothing is written yet."""
        self._folder = folder
        self._spec = spec
        self._container: OutputContainer | None = None
        self._stream: VideoStream | None = None
        self._file = -1
        self._frames = self._bytes = 0
        self._first = 0
        self._all_frames = self._all_bytes = 0

    def begin(self, frames: int) -> None:
        """Begin an episode of so many frames, in a new file where this one would grow too large."""
        expected = self._bytes + frames * self._all_bytes / max(self._all_frames, 1)
        is_large = expected >= self._spec.video_file_bytes
        is_long = self._frames + frames > MAX_FILE_S * self._spec.fps
        if self._container is None or ((is_large or is_long) and self._frames > 0):
            self.close()
            self._file += 1
            self._frames = self._bytes = 0
            path = _path(self._folder, names.VIDEO, self._file)
            self._container = av.open(library_name(path), "w", options={"movflags": "faststart"})
            stream = self._container.add_stream("libx264", self._spec.fps)
            stream.height, stream.width = self._spec.height, self._spec.width
            stream.pix_fmt, stream.options = "yuv420p", dict(_OPTIONS)
            stream.codec_context.time_base = Fraction(1, self._spec.fps)
            self._stream = stream
        self._first = self._frames

    def append(self, rgb: ImageArray) -> None:
        """Encode a frame [H, W, 3] uint8."""
        frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
        frame.pts, frame.time_base = self._frames, Fraction(1, self._spec.fps)
        if self._frames == self._first:
            frame.pict_type = av.video.frame.PictureType.I  # an episode is decoded by itself
        self._mux(frame)
        self._frames += 1
        self._all_frames += 1

    def end(self) -> VideoSpan:
        """End the episode; returns its place."""
        chunk, file = divmod(self._file, FILES_A_CHUNK)
        fps = self._spec.fps
        return VideoSpan(chunk, file, self._first / fps, self._frames / fps)

    def close(self) -> None:
        """Finish the file."""
        if self._container is not None:
            try:
                self._mux(None)
            finally:
                self._container.close()
                self._container = self._stream = None

    def _mux(self, frame: av.VideoFrame | None) -> None:
        if self._container is None or self._stream is None:
            raise ValueError("begin an episode first")
        packets = self._stream.encode(frame)
        size = sum(packet.size for packet in packets)
        self._bytes += size
        self._all_bytes += size
        self._container.mux(packets)


class TableFiles:
    """Tables of the rows, one row group an episode."""

    def __init__(self, folder: Path, spec: DatasetSpec) -> None:
        self._folder, self._limit_bytes = folder, spec.data_file_bytes
        self._writer: pq.ParquetWriter | None = None
        self._paths: list[Path] = []
        self._bytes = 0

    def append(self, table: pa.Table) -> tuple[int, int]:
        """Write an episode; returns its chunk and file."""
        if self._writer is None or self._bytes + table.nbytes >= self._limit_bytes:
            self.close()
            self._paths.append(_path(self._folder, names.DATA, len(self._paths)))
            self._writer = pq.ParquetWriter(
                library_name(self._paths[-1]), table.schema, compression="snappy"
            )
            self._bytes = 0
        self._writer.write_table(table)
        self._bytes += table.nbytes
        return divmod(len(self._paths) - 1, FILES_A_CHUNK)

    def close(self) -> None:
        """Finish the file."""
        if self._writer is not None:
            self._writer.close()
            self._writer = None

    def column(self, name: str) -> NDArray[np.generic]:
        """[rows, D] of all files."""
        files = map(library_name, self._paths)
        parts = [pq.read_table(file, columns=[name], partitioning=None) for file in files]
        column = pa.concat_tables(parts)[name].combine_chunks()
        values = column.flatten() if pa.types.is_fixed_size_list(column.type) else column
        return np.asarray(values.to_numpy()).reshape(len(column), -1)


def _path(folder: Path, pattern: str, number: int) -> Path:
    chunk, file = divmod(number, FILES_A_CHUNK)
    path = folder / pattern.format(video_key=names.CAMERA_KEY, chunk_index=chunk, file_index=file)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
