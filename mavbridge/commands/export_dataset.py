"""Writer of LeRobot datasets of format v3.0, episode by episode, with their statistics.

LeRobot's reader expects frame k of an episode at ``from_timestamp + k / fps``, within 0.1 ms
(lerobot 0.6.1, ``datasets/lerobot_dataset.py`` ``tolerance_s``, ``datasets/video_utils.py``), so a
video has one frame every 1/fps exactly, starting at 0.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from fractions import Fraction
from itertools import chain, islice
from pathlib import Path
from typing import Literal, TypeAlias

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from mavbridge.commands.config import ExportConfig
from mavbridge.core.records import ImageArray
from policy.adapters.interface import BODY_STATE_NAMES, state_values
from policy.contract import ACTION_NAMES, STATE_NAMES, StateFrame
from policy.data import lerobot_format as names
from policy.errors import DatasetError
from policy.files import library_name
from policy.preprocess import resize

MIN_ROWS = 2
"""Fewer rows show no motion."""
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
Stats: TypeAlias = dict[str, NDArray[np.float64] | NDArray[np.int64]]
"""By name; "count" is [1] int64, the others are as wide as the feature."""

DATA_FILE_MB, VIDEO_FILE_MB = 100, 200
"""LeRobot's defaults (``datasets/utils.py``) for recordings appended to the dataset."""
_PIXEL_STEP = 2
"""Every second pixel in each direction represents an image's colours."""
_LEVELS = 256
Json: TypeAlias = "str | int | float | bool | list[Json] | dict[str, Json] | None"

_ROW_NUMBERS = ("frame_index", "episode_index", "index", "task_index")


def vector_stats(values: NDArray[np.generic], counts: NDArray[np.int64] | None = None) -> Stats:
    """Return statistics of each column of values [N, D] or [N], N >= 1; ``counts`` [N, D] says how
    often each value occurs."""
    numbers = values.reshape(len(values), -1).astype(np.float64)
    counted = numbers if counts is None else np.where(counts > 0, numbers, np.nan)
    mean = np.average(numbers, axis=0, weights=counts)
    method: Literal["linear", "inverted_cdf"] = "linear" if counts is None else "inverted_cdf"
    return {
        "min": np.nanmin(counted, axis=0),
        "max": np.nanmax(counted, axis=0),
        "mean": mean,
        "std": np.sqrt(np.average((numbers - mean) ** 2, axis=0, weights=counts)),
        "count": np.array([len(numbers)], np.int64),
        **{
            name: np.quantile(numbers, at, axis=0, weights=counts, method=method)
            for name, at in QUANTILES.items()
        },
    }


def colour_counts(rgb: ImageArray) -> NDArray[np.int64]:
    """Return how often each level occurs in each channel of an image [H, W, 3] uint8, [3, 256]."""
    sample = rgb[::_PIXEL_STEP, ::_PIXEL_STEP].reshape(-1, 3).T
    return np.stack([np.bincount(channel, minlength=_LEVELS) for channel in sample])


def colour_stats(counts: NDArray[np.int64], images: int) -> Stats:
    """Return statistics [3, 1, 1] of colours in [0, 1]; "count" is the number of images."""
    levels = np.tile(np.arange(_LEVELS)[:, None] / (_LEVELS - 1), 3)
    found = {name: each.reshape(-1, 1, 1) for name, each in vector_stats(levels, counts.T).items()}
    return found | {"count": np.array([images], np.int64)}


FILES_A_CHUNK = 1000
"""LeRobot's ``DEFAULT_CHUNK_SIZE``."""
_OPTIONS: dict[str, object] = {
    "preset": "veryfast",
    "crf": "20",  # as the recorder's
    "g": "2",  # LeRobot's own: any frame is available after decoding two
    "tune": "zerolatency",  # a frame in, a packet out; none is before time 0
    "threads": "1",
}


@contextmanager
def episode_video(
    path: Path, fps: int, size: tuple[int, int]
) -> Iterator[Callable[[ImageArray, int], None]]:
    """Context manager: write frames of this height and width, each with its number from 0 on, to a
    video, H.264, yuv420p.

    Raises OSError or FFmpegError if it cannot be written.
    """
    with av.open(library_name(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", fps)
        stream.height, stream.width = size
        stream.pix_fmt, stream.options = "yuv420p", dict(_OPTIONS)
        stream.codec_context.time_base = Fraction(1, fps)

        def append(rgb: ImageArray, number: int) -> None:
            frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
            frame.pts, frame.time_base = number, Fraction(1, fps)
            container.mux(stream.encode(frame))

        yield append
        container.mux(stream.encode(None))


def episode_file(folder: Path, pattern: str, number: int) -> Path:
    """Return the path of one episode's file in an existing folder."""
    chunk, file = divmod(number, FILES_A_CHUNK)
    path = folder / pattern.format(video_key=names.CAMERA_KEY, chunk_index=chunk, file_index=file)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


class DatasetWriter:
    """Dataset that grows episode by episode; complete only after ``finish``.

    Each episode has its own video and table.
    """

    def __init__(
        self, folder: Path, config: ExportConfig, *, fps: int, state_frame: StateFrame
    ) -> None:
        """Prepare; nothing is written yet. The folder must exist and be empty."""
        self._folder, self._config = folder, config
        self._fps, self._state_frame = fps, state_frame
        self._state_names = BODY_STATE_NAMES if config.state == "body" else STATE_NAMES
        self._size: tuple[int, int] | None = None
        """Height and width of all images, even numbers; None before the first."""
        self._written: list[dict[str, NDArray[np.generic]]] = []
        """Columns of each episode's table."""
        self._episodes: list[dict[str, Json]] = []
        self._colours = np.zeros((3, _LEVELS), np.int64)
        self.rows = 0

    @property
    def episodes(self) -> int:
        """Number of episodes so far."""
        return len(self._episodes)

    def add(
        self, name: str, columns: dict[str, NDArray[np.generic]], images: Iterable[ImageArray]
    ) -> int:
        """Append an episode of the flight called ``name``; return the number of its rows.

        ``columns`` are rows for all images, as of a ``Stretch``. The episode ends early if its
        images do, and is left out if it has fewer than ``MIN_ROWS`` rows.

        Raises:
            DatasetError: images of another size.
            OSError, FFmpegError: it cannot be written.
        """
        size = self._config.image_size
        scaled = (np.ascontiguousarray(fit_size(rgb, size)) for rgb in images)
        first = list(islice(scaled, MIN_ROWS))
        if len(first) < MIN_ROWS:
            return 0
        self._size = self._size or (first[0].shape[0], first[0].shape[1])
        colours = np.zeros_like(self._colours)
        count = 0
        path = episode_file(self._folder, names.VIDEO, self.episodes)
        with episode_video(path, self._fps, self._size) as append:
            for image in chain(first, scaled):
                if image.shape[:2] != self._size:
                    raise DatasetError(
                        f"{name} has images of {image.shape[1]}x{image.shape[0]}, the "
                        f"first flight of {self._size[1]}x{self._size[0]}: export them apart"
                    )
                append(image, count)
                colours += colour_counts(image)
                count += 1
        rows = self._rows({key: values[:count] for key, values in columns.items()}, count)
        table = pa.table({key: _arrow(values) for key, values in rows.items()})
        path = episode_file(self._folder, names.DATA, self.episodes)
        pq.write_table(table, library_name(path))
        self._written.append(rows)
        stats = {key: vector_stats(values) for key, values in rows.items()}
        stats[names.CAMERA_KEY] = colour_stats(colours, count)
        self._colours += colours
        self._episodes.append(
            self._episode_row(count)
            | {
                f"stats/{feature}/{name}": values.tolist()
                for feature, found in stats.items()
                for name, values in found.items()
            }
        )
        self.rows += count
        return count

    def _rows(
        self, columns: dict[str, NDArray[np.generic]], count: int
    ) -> dict[str, NDArray[np.generic]]:
        frame_index = np.arange(count, dtype=np.int64)
        state = columns[names.STATE_KEY]
        wanted = state_values(list(state.T), STATE_NAMES, self._state_names)
        return {
            **columns,
            names.STATE_KEY: np.stack(wanted, axis=1),
            "timestamp": (frame_index / self._fps).astype(np.float32),
            "frame_index": frame_index,
            "episode_index": np.full(count, self.episodes, np.int64),
            "index": self.rows + frame_index,
            "task_index": np.zeros(count, np.int64),
        }

    def _episode_row(self, count: int) -> dict[str, Json]:
        """Return the columns of ``meta/episodes`` other than statistics."""
        chunk, file = divmod(self.episodes, FILES_A_CHUNK)
        video = f"videos/{names.CAMERA_KEY}/"
        return {
            "episode_index": self.episodes,
            "tasks": [self._config.task],
            "length": count,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.rows,
            "dataset_to_index": self.rows + count,
            f"{video}chunk_index": chunk,
            f"{video}file_index": file,
            f"{video}from_timestamp": 0.0,
            f"{video}to_timestamp": count / self._fps,
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }

    def finish(self) -> None:
        """Write the files about the whole dataset; raise DatasetError if no episode had images."""
        if self.rows == 0:
            raise DatasetError("nothing to export: not one image of these flights can be decoded")
        episodes = self._folder / names.EPISODES.format(chunk_index=0, file_index=0)
        episodes.parent.mkdir(parents=True)
        pq.write_table(_tasks(self._config.task), library_name(self._folder / names.TASKS))
        pq.write_table(pa.Table.from_pylist(self._episodes), library_name(episodes))
        stats = {
            name: vector_stats(np.concatenate([rows[name] for rows in self._written]))
            for name in self._features()
            if name != names.CAMERA_KEY
        }
        stats[names.CAMERA_KEY] = colour_stats(self._colours, self.rows)
        lists: Json = {
            feature: {name: values.tolist() for name, values in found.items()}
            for feature, found in stats.items()
        }
        for name, document in ((names.STATS, lists), (names.INFO, self._info())):
            text = json.dumps(document, indent=4, allow_nan=False)
            (self._folder / name).write_text(text + "\n")

    def _info(self) -> dict[str, Json]:
        return {
            "codebase_version": names.CODEBASE_VERSION,
            "robot_type": "mavlink",
            "total_episodes": self.episodes,
            "total_frames": self.rows,
            "total_tasks": 1,
            "chunks_size": FILES_A_CHUNK,
            "data_files_size_in_mb": DATA_FILE_MB,
            "video_files_size_in_mb": VIDEO_FILE_MB,
            "fps": self._fps,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": names.DATA,
            "video_path": names.VIDEO,
            "features": self._features(),
        }

    def _features(self) -> dict[str, Json]:
        height, width = self._size or (0, 0)
        camera: Json = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.fps": self._fps,
                "video.channels": 3,
                "is_depth_map": False,
                "has_audio": False,
            },
        }
        state_info: dict[str, Json] = {"info": {names.STATE_FRAME: self._state_frame}}
        return {
            names.CAMERA_KEY: camera,
            names.STATE_KEY: _feature("float32", self._state_names) | state_info,
            names.ACTION_KEY: _feature("float32", ACTION_NAMES),
            names.SENT: _feature("float32", ACTION_NAMES),
            **{name: _feature("int64") for name in names.STAMPS},
            "timestamp": _feature("float32"),
            **{name: _feature("int64") for name in _ROW_NUMBERS},
        }


def fit_size(rgb: ImageArray, image_size: int | None) -> ImageArray:
    """Scale the image to the dataset's size: ``image_size`` in height and width, or its own.

    An odd last row or column is cut off, which 4:2:0 cannot have.
    """
    if image_size is not None:
        return resize(rgb, image_size, image_size)
    height, width = rgb.shape[:2]
    return rgb[: height - height % 2, : width - width % 2]


def _arrow(values: NDArray[np.generic]) -> pa.Array:
    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _tasks(task: str) -> pa.Table:
    """Return ``task_index`` by ``task``: the reader takes the words from pandas' index."""
    columns: list[Json] = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": dtype}
        | {"metadata": None}
        for name, kind, dtype in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas: Json = {"index_columns": ["task"], "column_indexes": [], "columns": columns}
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [task]})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _feature(dtype: str, columns: tuple[str, ...] = ()) -> dict[str, Json]:
    return {"dtype": dtype, "shape": [len(columns) or 1], "names": list(columns) or None}
