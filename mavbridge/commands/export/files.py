"""Rows for the frames of flights, and the video of each episode.

A row holds the data known at the exposure of its image: the state of the newest tick whose messages
had all arrived by then, and the newest sticks to imitate up to then. Nothing is interpolated; the
stamps give the age of each.

LeRobot's reader expects frame k of an episode at ``from_timestamp + k / fps``, within 0.1 ms
(lerobot 0.6.1, ``datasets/lerobot_dataset.py`` ``tolerance_s``, ``datasets/video_utils.py``), so a
video has one frame every 1/fps exactly, starting at 0.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import groupby, pairwise
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.records import ImageArray
from policy.contract import ACTION_DIM, STATE_NAMES, StateFrame
from policy.data import lerobot_format as names
from policy.data.flight_data import FlightData, Nanoseconds
from policy.data.interpolation import MAX_GAP_NS
from policy.files import library_name

MAX_HELD_NS = MAX_GAP_NS
"""A state or sticks older than this no longer belong to a frame."""
MAX_MISSING_FRAMES = 1
"""Longest run of missing frames. After a longer one a new episode begins, because LeRobot assumes
rows at equal intervals."""
MIN_ROWS = 2
"""Fewer rows show no motion."""
MAX_RATE_OFF = 0.2
"""Largest relative difference between the rate of a flight and the common rate."""


@dataclass(frozen=True)
class Stretch:
    """Consecutive frames of a flight during which it was flown: one LeRobot episode."""

    episode: FlightData
    first_frame: int
    columns: dict[str, NDArray[np.generic]]
    """State [N, 13], action and sent sticks [N, 4], then the stamps [N], under their names in the
    dataset. Sent sticks are zeros if they were released or none had been sent yet."""

    def __len__(self) -> int:
        return len(self.captured_ns)

    @property
    def captured_ns(self) -> Nanoseconds:
        """Exposures, [N]."""
        return self.columns[names.CAPTURED].astype(np.int64, copy=False)

    def part(self, start: int, stop: int) -> "Stretch":
        """Return the rows from ``start`` up to ``stop``."""
        columns = {name: values[start:stop] for name, values in self.columns.items()}
        return Stretch(self.episode, self.first_frame + start, columns)


def stretches(episode: FlightData) -> list[Stretch]:
    """Align a flight to its frames, and leave out frames without a state or sticks."""
    captured_ns = episode.captured_ns
    arrived_ns = np.maximum.accumulate(np.maximum(episode.attitude_ns, episode.velocity_ns))
    tick = _newest(arrived_ns, captured_ns)
    target = _newest(episode.target_ns, captured_ns)
    sent = _newest(episode.sent_ns, captured_ns)
    is_known = (tick >= 0) & (target >= 0)
    is_known &= captured_ns - arrived_ns[tick] <= MAX_HELD_NS
    is_known &= captured_ns - episode.target_ns[target] <= MAX_HELD_NS
    is_known &= np.isfinite(episode.state[tick]).all(axis=1)
    # If nothing had been sent yet, index -1 selects the appended row.
    sent_sticks = np.concatenate([episode.sent, np.zeros((1, ACTION_DIM), np.float32)])[sent]
    sent_ns = np.where(sent < 0, captured_ns, np.append(episode.sent_ns, 0)[sent])
    stamps = (
        *(captured_ns, episode.tick_ns[tick], episode.attitude_ns[tick]),
        *(episode.velocity_ns[tick], episode.target_ns[target], sent_ns.astype(np.int64)),
    )
    columns: dict[str, NDArray[np.generic]] = {
        names.STATE_KEY: episode.state[tick],
        names.ACTION_KEY: episode.target[target],
        names.SENT: sent_sticks,
        **dict(zip(names.STAMPS, stamps, strict=True)),
    }
    whole = Stretch(episode, 0, columns)
    return [whole.part(start, stop) for start, stop in _runs(captured_ns, is_known)]


def _newest(stamps_ns: Nanoseconds, at_ns: Nanoseconds) -> NDArray[np.intp]:
    """Return [N], the index of the newest stamp at or before each time; -1 if there is none."""
    return np.searchsorted(stamps_ns, at_ns, side="right") - 1


def _runs(captured_ns: Nanoseconds, is_known: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Return the runs of known frames without a hole: start and stop index of each."""
    if len(captured_ns) < MIN_ROWS:
        return []
    periods = np.diff(captured_ns)
    longest = (MAX_MISSING_FRAMES + 1.5) * np.median(periods)
    is_cut = (periods > longest) | (is_known[1:] != is_known[:-1])
    edges = [0, *(np.flatnonzero(is_cut) + 1).tolist(), len(captured_ns)]
    return [(a, b) for a, b in pairwise(edges) if is_known[a] and b - a >= MIN_ROWS]


def common_fps(parts: Sequence[Stretch]) -> int:
    """Return the integer frame rate that LeRobot assumes for all frames.

    Raises:
        UserError: flights of several rates.
    """
    fps = max(1, round(_rate_hz(np.concatenate([np.diff(p.captured_ns) for p in parts]))))
    # Per flight, because a stretch of a few frames has no rate of its own.
    for _, of_flight in groupby(parts, key=lambda part: id(part.episode)):
        whole = list(of_flight)
        own = _rate_hz(np.concatenate([np.diff(part.captured_ns) for part in whole]))
        if abs(own / fps - 1.0) > MAX_RATE_OFF:
            raise UserError(
                f"{whole[0].episode.name} has {own:.3g} frames a second, most of the rest {fps}: a "
                "LeRobot dataset has one rate, so export them apart"
            )
    return fps


def _rate_hz(periods_ns: Nanoseconds) -> float:
    whole = periods_ns[periods_ns <= 1.5 * np.median(periods_ns)]
    return NS_PER_S / float(np.maximum(whole.mean(), 1.0))


def worst_shift_ns(part: Stretch, fps: int) -> int:
    """Return the largest distance of a frame from its place on LeRobot's even grid."""
    even_ns = np.round(np.arange(len(part)) * (NS_PER_S / fps)).astype(np.int64)
    return int(np.abs(part.captured_ns - part.captured_ns[0] - even_ns).max())


FILES_A_CHUNK = 1000
"""LeRobot's ``DEFAULT_CHUNK_SIZE``."""
_OPTIONS: dict[str, object] = {
    "preset": "veryfast",
    "crf": "20",  # as the recorder's
    "g": "2",  # LeRobot's own: any frame is available after decoding two
    "tune": "zerolatency",  # a frame in, a packet out; none is before time 0
    "threads": "1",
}


@dataclass(frozen=True, kw_only=True)
class DatasetSpec:
    """Properties shared by all episodes."""

    fps: int
    height: int
    """Image height, even like ``width``."""
    width: int
    state_frame: StateFrame
    task: str
    state_names: tuple[str, ...] = STATE_NAMES
    """Names of the numbers in ``observation.state``: by the contract or ``adapters.interface``."""


class EpisodeVideo:
    """Video of one episode, H.264, yuv420p, starting at time 0.

    Methods raise OSError or FFmpegError if it cannot be written.
    """

    def __init__(self, path: Path, spec: DatasetSpec) -> None:
        """Create the file."""
        self._container = av.open(library_name(path), "w", options={"movflags": "faststart"})
        self._stream = self._container.add_stream("libx264", spec.fps)
        self._stream.height, self._stream.width = spec.height, spec.width
        self._stream.pix_fmt, self._stream.options = "yuv420p", dict(_OPTIONS)
        self._time_base = self._stream.codec_context.time_base = Fraction(1, spec.fps)
        self._frames = 0

    def append(self, rgb: ImageArray) -> None:
        """Encode a frame [H, W, 3] uint8."""
        frame = av.VideoFrame.from_ndarray(rgb, format="rgb24")
        frame.pts, frame.time_base = self._frames, self._time_base
        self._container.mux(self._stream.encode(frame))
        self._frames += 1

    def close(self) -> None:
        """Finish the file."""
        try:
            self._container.mux(self._stream.encode(None))
        finally:
            self._container.close()


def episode_file(folder: Path, pattern: str, number: int) -> Path:
    """Return the path of one episode's file in an existing folder."""
    chunk, file = divmod(number, FILES_A_CHUNK)
    path = folder / pattern.format(video_key=names.CAMERA_KEY, chunk_index=chunk, file_index=file)
    path.parent.mkdir(parents=True, exist_ok=True)
    return path
