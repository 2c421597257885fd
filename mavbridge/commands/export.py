"""``mavbridge export``: flights in, a LeRobot dataset out, complete or not at all.

A row holds the data known at the exposure of its image: the newest state measured by then, and
the newest sticks to imitate up to then. Nothing is interpolated; the stamps give the age of each.
"""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import chain, groupby, islice, pairwise
from pathlib import Path
from shutil import rmtree
from statistics import median_low

import numpy as np
from av.error import FFmpegError
from numpy.typing import NDArray

from mavbridge.commands.config import ExportConfig
from mavbridge.commands.export_dataset import MIN_ROWS, DatasetWriter
from mavbridge.commands.output import print_warnings, progress_bar, text_console
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.files import empty_folders_removed
from mavbridge.core.records import ImageArray
from policy.adapters.drafts import Entry, dataset_entries, draft_text, recorded_entries
from policy.contract import ACTION_DIM, STICK_TERMS
from policy.data import lerobot_format as names
from policy.data.flight_data import FlightData, Nanoseconds, common_contract
from policy.data.flight_folders import find_flights, leave_out_failed, read_flights
from policy.data.interpolation import MAX_GAP_NS
from policy.files import CONTRACT_FILE

MAX_HELD_NS = MAX_GAP_NS
"""A state or sticks older than this no longer belong to a frame."""
MAX_MISSING_FRAMES = 1
"""Longest run of missing frames. After a longer one a new episode begins, because LeRobot assumes
rows at equal intervals."""
MAX_RATE_OFF = 0.2
"""Largest relative difference between a flight's rate and the common one."""


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


def stretches(episode: FlightData) -> list[Stretch]:
    """Align a flight to its frames, and leave out frames without a state or sticks."""
    captured_ns = episode.captured_ns
    measured_ns = np.maximum.accumulate(np.maximum(episode.attitude_ns, episode.velocity_ns))
    tick = _newest(measured_ns, captured_ns)
    target = _newest(episode.target_ns, captured_ns)
    sent = _newest(episode.sent_ns, captured_ns)
    is_known = (tick >= 0) & (target >= 0)
    is_known &= captured_ns - measured_ns[tick] <= MAX_HELD_NS
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
    return [
        Stretch(episode, start, {name: values[start:stop] for name, values in columns.items()})
        for start, stop in _runs(captured_ns, is_known)
    ]


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
    """Return the integer frame rate that LeRobot assumes for all frames, or raise UserError."""
    # Per flight, because a stretch of a few frames has no rate of its own.
    flights = [list(each) for _, each in groupby(parts, key=lambda part: id(part.episode))]
    rates_hz = {flight[0].episode.name: _rate_hz(flight) for flight in flights}
    fps = max(1, round(median_low(rates_hz.values())))
    for name, own_hz in rates_hz.items():
        if abs(own_hz / fps - 1.0) > MAX_RATE_OFF:
            raise UserError(
                f"{name} has {own_hz:.3g} frames a second, and a LeRobot dataset one whole number "
                f"for all its flights, here {fps}: export it apart, record at {fps}, or use "
                "--format mcap"
            )
    return fps


def _rate_hz(parts: Sequence[Stretch]) -> float:
    periods_ns = np.concatenate([np.diff(part.captured_ns) for part in parts])
    whole = periods_ns[periods_ns <= 1.5 * np.median(periods_ns)]
    return NS_PER_S / float(np.maximum(whole.mean(), 1.0))


def worst_shift_ns(part: Stretch, fps: int) -> int:
    """Return the largest distance of a frame from its place on LeRobot's even grid."""
    even_ns = np.round(np.arange(len(part)) * (NS_PER_S / fps)).astype(np.int64)
    return int(np.abs(part.captured_ns - part.captured_ns[0] - even_ns).max())


def export(flights: Sequence[Path], config: ExportConfig) -> int:
    """Export flights."""
    console = text_console(stderr=True)
    folders = find_flights(flights)
    exemplary, note = leave_out_failed(folders, include_failed=config.include_failed)
    if note is not None:
        console.print(note, soft_wrap=True)
    with progress_bar(console) as progress, whole_or_nothing(config.out) as folder:
        reading = progress.add_task("reading flights", total=len(exemplary), status="")
        episodes, left_out = read_flights(exemplary, progress=lambda: progress.advance(reading))
        print_warnings(console, left_out + [text for each in episodes for text in each.damage])
        frames = sum(len(episode.captured_ns) for episode in episodes)
        writing = progress.add_task("writing frames", total=frames, status="")
        summary = write_dataset(episodes, folder, config, lambda: progress.advance(writing))
        write_contract(folder, episodes, config)
    text_console().print(f"{config.out}: {summary}", soft_wrap=True)
    return 0


def write_dataset(
    episodes: Sequence[FlightData],
    folder: Path,
    config: ExportConfig,
    on_frame: Callable[[], None] = lambda: None,
) -> str:
    """Write flights into an empty folder; ``on_frame`` is called for every decoded frame.

    Return what was written, in a line for the user.

    Raises:
        UserError, DatasetError: damaged flights, or they do not fit in one dataset.
    """
    flown = common_contract(list(episodes))
    if flown.action != "sticks":
        raise UserError(f"these flights were flown by {flown.action}: this command exports sticks")
    parts = [stretches(episode) for episode in episodes]
    every = list(chain.from_iterable(parts))
    if not every:
        raise UserError(
            f"nothing to export: in {len(episodes)} flights no frame has a state and sticks at "
            "its exposure: are camera and telemetry of one clock?"
        )
    fps = common_fps(every)
    writer = DatasetWriter(folder, config, fps=fps, state_frame=flown.state_frame)
    for episode, of_flight in zip(episodes, parts, strict=True):
        images, at = _decoded(episode, on_frame), 0
        for part in of_flight:  # the video is decoded once, from its beginning
            skipped = sum(1 for _ in islice(images, part.first_frame - at))
            at += skipped + writer.add(episode.name, part.columns, islice(images, len(part)))
    writer.finish()
    shift_ms = max(worst_shift_ns(part, fps) for part in every) / NS_PER_MS
    return (
        f"{writer.episodes} episodes, {writer.rows} frames at {fps} Hz; an exposure is at most "
        f"{shift_ms:.0f} ms from its timestamp (the true stamps are in the stamp.* columns)"
    )


def write_contract(dataset: Path, episodes: Sequence[FlightData], config: ExportConfig) -> None:
    """Write the contract file for policies trained on these flights."""
    # The only camera is the vehicle's own under any name: the contract's default.
    told = ("cameras", *STICK_TERMS)
    entries = [
        *(entry for entry in dataset_entries(dataset) if entry.name not in told),
        *recorded_entries([each.contract for each in episodes]),
        Entry("task", "prompt", config.task, "--task"),
    ]
    title = (
        "Contract of the policies that are trained on this dataset, written by mavbridge export: "
        "mavbridge --policy lerobot:DIR --contract THIS_FILE"
    )
    (dataset / CONTRACT_FILE).write_text(draft_text(title, entries), encoding="utf-8")


def _decoded(episode: FlightData, on_frame: Callable[[], None]) -> Iterator[ImageArray]:
    for image in episode.decode():
        on_frame()
        yield image


@contextmanager
def whole_or_nothing(out: Path) -> Iterator[Path]:
    """Context manager: a folder in ``out`` whose contents move to ``out`` when it is complete.

    ``out`` is new or empty, perhaps a mounted folder. SIGTERM ends the block as Ctrl-C does, and
    nothing stays. Raises UserError if ``out`` is taken or cannot be written.
    """
    part = out / ".unfinished"
    with empty_folders_removed(out):
        try:
            if out.exists() and (not out.is_dir() or any(out.iterdir())):
                raise UserError(
                    f"--out {out} is there and not empty (an export that was killed leaves "
                    f"{part.name}): name a new folder, or empty it"
                )
            part.mkdir(parents=True)
            terminate = signal.signal(signal.SIGTERM, signal.default_int_handler)
            try:
                yield part
                for entry in list(part.iterdir()):
                    entry.rename(out / entry.name)
            finally:
                rmtree(part, ignore_errors=True)
                signal.signal(signal.SIGTERM, terminate)
        except (OSError, FFmpegError) as error:
            raise UserError(f"--out {out} cannot be written: {error.strerror or error}") from error
