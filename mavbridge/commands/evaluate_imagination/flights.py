"""Windows of frames to evaluate, evenly spaced over recorded flights."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.errors import UserError
from mavbridge.core.records import FloatArray, ImageArray
from mavbridge.recording.flight_folder import open_flight
from policy.data.flight_data import DatasetError, FlightData
from policy.data.flight_folders import read_flight
from policy.data.windows import find_windows
from policy.preprocess import resize
from policy.world_model.config import WorldModelConfig


@dataclass(frozen=True, kw_only=True)
class FlightWindow:
    """``K`` = context_frames and ``S`` later steps of one flight, ``frame_dt_s`` apart."""

    folder: Path
    frames: NDArray[np.int64]
    """[K + S] rows of the flight's frames."""
    states: FloatArray
    """[K + S, 13] at the exposures."""
    actions: FloatArray
    """[S, 4] mean stick that was sent from the frame before to each frame after the context."""


def read_episode(folder: Path, config: WorldModelConfig) -> FlightData:
    """Read states, sticks and stamps of a flight, as far as it has whole frames.

    Raises:
        UserError: its states are in another frame than the model's.
        MavbridgeError: it cannot be read.
    """
    episode = read_flight(folder)
    if episode.state_frame != config.contract.state_frame:
        raise UserError(
            f"{folder} has its states in {episode.state_frame}, the world model takes "
            f"{config.contract.state_frame}: name flights of that kind, or a world model that was "
            "trained on these"
        )
    return episode.first_frames(open_flight(folder).frames.num_rows)


def choose_windows(
    episodes: Sequence[FlightData], config: WorldModelConfig, *, steps: int, count: int
) -> tuple[list[FlightWindow], int]:
    """Choose windows with ``steps`` after the context, evenly over all flights.

    Returns:
        At most ``count`` windows, in the order of flights and frames, and how many of the flights
        have any.
    """
    if not episodes:
        return [], 0
    try:
        every = find_windows(
            episodes,
            context_frames=config.context_frames,
            frames=steps,
            frame_dt_s=config.frame_dt_s,
        )
    except DatasetError:  # the only one: there is no window
        return [], 0
    first_frames = np.cumsum([0, *(len(episode.captured_ns) for episode in episodes)])
    flights_of_all = np.searchsorted(first_frames, every.frames[:, 0], side="right") - 1
    chosen = every.spread(count)
    samples = chosen.samples(np.arange(len(chosen)))
    flights = np.searchsorted(first_frames, chosen.frames[:, 0], side="right") - 1
    windows = [
        FlightWindow(
            folder=Path(episodes[flight].name),
            frames=samples.frames[row] - first_frames[flight],
            states=samples.states[row],
            actions=samples.actions[row],
        )
        for row, flight in enumerate(flights)
    ]
    return windows, len(np.unique(flights_of_all))


def with_images(
    windows: Sequence[FlightWindow], steps: Sequence[int], size: int
) -> Iterator[tuple[FlightWindow, dict[int, ImageArray]]]:
    """Each window with its images [size, size, 3] at ``steps``, which count from the context on.

    Raises:
        MavbridgeError: a flight cannot be read, or its video is damaged.
    """
    for folder, group in groupby(windows, key=lambda window: window.folder):
        waiting = deque(group)
        needed = {int(window.frames[step]) for window in waiting for step in steps}
        kept: dict[int, ImageArray] = {}
        for frame, rgb in enumerate(open_flight(folder).rgb_images()):
            if frame in needed:
                kept[frame] = resize(rgb, size, size)
            while waiting and waiting[0].frames[-1] <= frame:
                window = waiting.popleft()
                yield window, {step: kept[int(window.frames[step])] for step in steps}
            if not waiting:
                break
            kept = {k: image for k, image in kept.items() if k >= waiting[0].frames[0]}
