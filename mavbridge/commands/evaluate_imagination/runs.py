"""What is evaluated: runs of frames, evenly spaced over recorded flights."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.records import FloatArray, ImageArray
from mavbridge.recording.flight_folder import open_flight
from policy.data.flight_data import DatasetError, FlightData
from policy.data.flight_folders import find_flights, is_exemplary, read_flight
from policy.data.windows import Windows, find_windows
from policy.preprocess import resize
from policy.world_model.config import WorldModelConfig

Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Run:
    """``context_frames + S`` steps of one flight, ``frame_dt_s`` apart."""

    folder: Path
    frames: Indices
    """[K + S] rows of the flight's frames."""
    at_s: NDArray[np.float64]
    """[K + S] exposures since the first of them."""
    states: FloatArray
    """[K + S, 13] at the exposures."""
    actions: FloatArray
    """[S, 4] mean stick that was sent from the frame before to each frame after the context."""


@dataclass(frozen=True, kw_only=True)
class Survey:
    """What one flight has to offer."""

    folder: Path
    windows: int
    """Runs of one imagined future."""
    chain_iterations: int
    """Of the longest chain that the flight holds the frames and sticks for, as far as asked."""
    chains: int
    """Runs of that length."""

    def chains_of(self, iterations: int) -> int:
        """Runs of just so many iterations."""
        return self.chains if self.chain_iterations == iterations else 0


def find_folders(paths: Sequence[Path]) -> tuple[list[Path], int]:
    """The flights, and how many demonstrations that failed were left out, as in training.

    Raises:
        PolicyError: a path that holds no flights.
    """
    found = find_flights(paths)
    kept = [folder for folder in found if is_exemplary(folder)]
    return kept, len(found) - len(kept)


def survey(
    folder: Path, config: WorldModelConfig, *, exe_steps: int, iterations: int
) -> Survey | None:
    """Count the runs of one flight; None if it is too short for one.

    Raises:
        UserError: its states are in another frame than the model's.
        MavbridgeError, PolicyError: it cannot be read.
    """
    episode = _read(folder, config)
    windows = _find(episode, config, config.frames)
    if windows is None:
        return None
    longest, chains = 1, len(windows)
    for count in range(iterations, 1, -1):
        found = _find(episode, config, chain_steps(config, exe_steps, count))
        if found is not None:
            longest, chains = count, len(found)
            break
    return Survey(folder=folder, windows=len(windows), chain_iterations=longest, chains=chains)


def chain_steps(config: WorldModelConfig, exe_steps: int, iterations: int) -> int:
    """Steps after the context that a chain needs the sticks of."""
    return (iterations - 1) * exe_steps + config.frames


def spread(counts: Sequence[int], most: int) -> list[Indices]:
    """At most ``most`` of all runs, evenly: the rows of each flight, given how many it has."""
    total = sum(counts)
    rows = np.linspace(0, total - 1, min(most, total)).astype(np.int64) if total else np.zeros(0)
    ends = np.cumsum(counts)
    return [
        (rows[(rows >= end - count) & (rows < end)] - (end - count)).astype(np.int64)
        for end, count in zip(ends, counts, strict=True)
    ]


def read_runs(folder: Path, config: WorldModelConfig, steps: int, rows: Indices) -> list[Run]:
    """Some of the runs of one flight with so many steps after the context."""
    if len(rows) == 0:
        return []
    windows = _find(_read(folder, config), config, steps)
    if windows is None:
        raise DatasetError(f"{folder} has changed while it was read: run this again")
    samples = windows.samples(rows)
    stamps_ns = windows.captured_ns[samples.frames]
    return [
        Run(
            folder=folder,
            frames=samples.frames[row],
            at_s=(stamps_ns[row] - stamps_ns[row, 0]) / NS_PER_S,
            states=samples.states[row],
            actions=samples.actions[row],
        )
        for row in range(len(rows))
    ]


def with_images(
    runs: Sequence[Run], steps: Sequence[int], size: int
) -> Iterator[tuple[Run, dict[int, ImageArray]]]:
    """Each run with the images [size, size, 3] of some of its steps, by step.

    Args:
        runs: of one flight and one length, in the order of their frames.
        steps: from 0, the first of the context.
        size: of the images, px.

    Raises:
        MavbridgeError: the flight cannot be read, or its video is damaged.
    """
    if not runs:
        return
    waiting = deque(runs)
    needed = {int(run.frames[step]) for run in runs for step in steps}
    kept: dict[int, ImageArray] = {}
    for frame, rgb in enumerate(open_flight(runs[0].folder).images()):
        if frame in needed:
            kept[frame] = resize(rgb, size, size)
        while waiting and waiting[0].frames[-1] <= frame:
            run = waiting.popleft()
            yield run, {step: kept[int(run.frames[step])] for step in steps}
            if not waiting:
                return
            first = waiting[0].frames[0]
            kept = {index: image for index, image in kept.items() if index >= first}


def _read(folder: Path, config: WorldModelConfig) -> FlightData:
    episode = read_flight(folder)
    if episode.state_frame != config.contract.state_frame:
        raise UserError(
            f"{folder} has its states in {episode.state_frame}, the world model takes "
            f"{config.contract.state_frame}: name flights of that kind, or a world model that was "
            "trained on these"
        )
    return episode.first_frames(open_flight(folder).frames.num_rows)


def _find(episode: FlightData, config: WorldModelConfig, steps: int) -> Windows | None:
    try:
        return find_windows(
            [episode],
            context_frames=config.context_frames,
            frames=steps,
            frame_dt_s=config.frame_dt_s,
        )
    except DatasetError:  # all that it refuses: there is none
        return None
