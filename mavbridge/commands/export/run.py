"""The whole of ``mavbridge export``: flights in, a LeRobot dataset out, whole or not at all."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from shutil import rmtree

from av.error import FFmpegError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from mavbridge.commands.export.dataset import (
    MB,
    VIDEO_FILE_MB,
    DatasetSpec,
    DatasetWriter,
    even_size,
)
from mavbridge.commands.export.rows import Stretch, common_fps, stretches, worst_shift_ns
from mavbridge.config.export import ExportConfig
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.core.records import ImageArray
from mavbridge.core.stopping import stop_on_signals
from policy.data.flight_data import FlightData, common_frame
from policy.data.flight_folders import find_flights, is_exemplary, read_flight


@dataclass(frozen=True, kw_only=True)
class Exported:
    """What was written."""

    episodes: int
    rows: int
    fps: int
    frames_lost: int
    """At the ends of videos that break off."""
    worst_shift_ns: int
    """Between an exposure and its place on the even grid."""


def export(flights: Sequence[Path], config: ExportConfig) -> int:
    """Export flights as the config says.

    Raises:
        MavbridgeError, PolicyError: for whatever a person can have caused.
    """
    console = Console(stderr=True, highlight=False, emoji=False)
    folders = find_flights(flights)
    exemplary = [folder for folder in folders if is_exemplary(folder)]
    if not exemplary:
        raise UserError("nothing to export: these demonstrations all failed")
    if failed := len(folders) - len(exemplary):
        console.print(f"left out: {failed} of {len(folders)} flights, demonstrations that failed")
    with stop_on_signals() as stop, _progress(console) as progress, _whole(config.out) as folder:
        reading = progress.add_task("reading flights", total=len(exemplary))
        episodes = []
        for flight in exemplary:
            _heed(stop.is_set)
            episodes.append(read_flight(flight))
            progress.advance(reading)
        frames = sum(len(episode.captured_ns) for episode in episodes)
        writing = progress.add_task("writing frames", total=frames)

        def on_frame() -> None:
            _heed(stop.is_set)
            progress.advance(writing)

        done = write_dataset(episodes, folder, config, on_frame)
    _print(done, config.out)
    return 0


def write_dataset(
    episodes: Sequence[FlightData],
    folder: Path,
    config: ExportConfig,
    on_frame: Callable[[], None] = lambda: None,
    *,
    data_file_bytes: int | None = None,
    video_file_bytes: int = VIDEO_FILE_MB * MB,
) -> Exported:
    """Write flights into an empty folder.

    Args:
        episodes: the flights.
        folder: there, and empty.
        config: says the task.
        on_frame: called with every frame that was looked at.
        data_file_bytes: most of a table; LeRobot's default if None.
        video_file_bytes: most of a video.

    Raises:
        UserError, VideoError, DatasetError: flights that cannot be in one dataset, or damaged.
    """
    parts = {index: stretches(episode) for index, episode in enumerate(episodes)}
    every = [part for inside in parts.values() for part in inside]
    if not every:
        raise UserError(
            f"nothing to export: in {len(episodes)} flights no frame has a state and sticks at "
            "its exposure: are camera and telemetry of one clock?"
        )
    fps = common_fps(every)
    height, width = _image_size(every)
    spec = DatasetSpec(
        fps=fps,
        height=height,
        width=width,
        state_frame=common_frame(list(episodes)),
        task=config.task,
        video_file_bytes=video_file_bytes,
    )
    if data_file_bytes is not None:
        spec = replace(spec, data_file_bytes=data_file_bytes)
    writer = DatasetWriter(folder, spec)
    try:
        for index, episode in enumerate(episodes):
            _write_flight(writer, episode, parts[index], on_frame)
        writer.finish()
    finally:
        writer.close()
    return Exported(
        episodes=writer.episodes,
        rows=writer.rows,
        fps=fps,
        frames_lost=sum(map(len, every)) - writer.rows,
        worst_shift_ns=max(worst_shift_ns(part, fps) for part in every),
    )


def _image_size(parts: Sequence[Stretch]) -> tuple[int, int]:
    for part in parts:
        for image in part.episode.decode():
            return even_size(image)
    raise UserError("nothing to export: not one image of these flights can be decoded")


def _write_flight(
    writer: DatasetWriter, episode: FlightData, parts: list[Stretch], on_frame: Callable[[], None]
) -> None:
    """The video is decoded once, from its beginning."""
    images = _counted(episode.decode(), on_frame)
    at = 0
    for part in parts:
        skipped = sum(1 for _ in islice(images, part.first_frame - at))
        written = writer.add(part, islice(images, len(part)))
        at += skipped + written


def _counted(images: Iterator[ImageArray], on_frame: Callable[[], None]) -> Iterator[ImageArray]:
    for image in images:
        on_frame()
        yield image


def _heed(should_stop: Callable[[], bool]) -> None:
    if should_stop():
        raise KeyboardInterrupt


@contextmanager
def _whole(out: Path) -> Iterator[Path]:
    """A folder beside ``out`` that takes its name once the dataset in it is whole.

    Raises:
        UserError: ``out`` holds something, or cannot be written.
    """
    part = out.with_name(f"{out.name}.unfinished")
    try:
        if out.exists() and (not out.is_dir() or any(out.iterdir())):
            raise UserError(f"--out {out} is there and not empty: name a new folder")
        out.parent.mkdir(parents=True, exist_ok=True)
        part.mkdir()
    except FileExistsError as error:
        raise UserError(
            f"{part} is left of an export that was killed, or another one is at work there: "
            "remove it, or name another --out"
        ) from error
    except OSError as error:
        raise UserError(f"--out {out} cannot be written: {error.strerror or error}") from error
    try:
        yield part
        part.rename(out)
    except (OSError, FFmpegError) as error:
        raise UserError(f"--out {out} cannot be written: {error.strerror or error}") from error
    finally:
        rmtree(part, ignore_errors=True)


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=console,
    )


def _print(done: Exported, out: Path) -> None:
    console = Console(highlight=False)
    console.print(
        f"{out}: {done.episodes} episodes, {done.rows} frames at {done.fps} Hz; an exposure is at "
        f"most {done.worst_shift_ns / NS_PER_MS:.0f} ms from its timestamp (the true stamps are in "
        "the stamp.* columns)",
        soft_wrap=True,
    )
    if done.frames_lost:
        console.print(f"{done.frames_lost} frames are missing at the end of videos that break off")
