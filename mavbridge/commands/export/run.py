"""``mavbridge export``: flights in, a LeRobot dataset out, complete or not at all."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path
from shutil import rmtree

from av.error import FFmpegError
from rich.console import Console
from rich.progress import TaskID

from mavbridge.commands.config import ExportConfig
from mavbridge.commands.export.dataset import DatasetWriter, fit_size
from mavbridge.commands.export.files import (
    DatasetSpec,
    common_fps,
    stretches,
    worst_shift_ns,
)
from mavbridge.commands.output import progress_bar
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.core.records import ImageArray
from mavbridge.core.stopping import stop_on_signals
from policy.adapters.drafts import Entry, dataset_entries, draft_text, recorded_entries
from policy.adapters.interface import BODY_STATE_NAMES, CONTRACT_FILE
from policy.contract import STATE_NAMES
from policy.data.flight_data import DatasetError, FlightData, common_frame, common_terms
from policy.data.flight_folders import find_flights, leave_out_failed, read_flight
from policy.files import read_object


def export(flights: Sequence[Path], config: ExportConfig) -> int:
    """Export flights."""
    console = Console(stderr=True, highlight=False, emoji=False)
    folders = find_flights(flights)
    exemplary, note = leave_out_failed(folders, include_failed=config.include_failed)
    if note is not None:
        console.print(note, soft_wrap=True)
    with (
        stop_on_signals() as stop,
        progress_bar(console) as progress,
        _whole_or_nothing(config.out) as folder,
    ):

        def advance(task: TaskID) -> None:
            if stop.is_set():
                raise KeyboardInterrupt
            progress.advance(task)

        reading = progress.add_task("reading flights", total=len(exemplary), status="")
        episodes = []
        for flight in exemplary:
            episodes.append(read_flight(flight))
            for text in episodes[-1].damage:
                console.print(f"warning: {text}", soft_wrap=True)
            advance(reading)
        frames = sum(len(episode.captured_ns) for episode in episodes)
        writing = progress.add_task("writing frames", total=frames, status="")
        summary = write_dataset(episodes, folder, config, lambda: advance(writing))
        write_contract(folder, exemplary, config)
    Console(highlight=False).print(f"{config.out}: {summary}", soft_wrap=True)
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
        UserError, VideoError, DatasetError: damaged flights, or they do not fit in one dataset.
    """
    if (action := common_terms(list(episodes)).action) != "sticks":
        raise UserError(f"these flights were flown by {action}: this command exports sticks")
    parts = [stretches(episode) for episode in episodes]
    every = list(chain.from_iterable(parts))
    if not every:
        raise UserError(
            f"nothing to export: in {len(episodes)} flights no frame has a state and sticks at "
            "its exposure: are camera and telemetry of one clock?"
        )
    fps = common_fps(every)
    first = next(chain.from_iterable(part.episode.decode() for part in every), None)
    if first is None:
        raise UserError("nothing to export: not one image of these flights can be decoded")
    height, width = fit_size(first, config.image_size).shape[:2]
    spec = DatasetSpec(
        fps=fps,
        height=height,
        width=width,
        state_frame=common_frame(list(episodes)),
        task=config.task,
        state_names=BODY_STATE_NAMES if config.state == "body" else STATE_NAMES,
    )
    writer = DatasetWriter(folder, spec, config.image_size)
    for episode, of_flight in zip(episodes, parts, strict=True):
        images, at = _decoded(episode, on_frame), 0
        for part in of_flight:  # the video is decoded once, from its beginning
            skipped = sum(1 for _ in islice(images, part.first_frame - at))
            at += skipped + writer.add(part, islice(images, len(part)))
    writer.finish()
    shift_ms = max(worst_shift_ns(part, fps) for part in every) / NS_PER_MS
    return (
        f"{writer.episodes} episodes, {writer.rows} frames at {fps} Hz; an exposure is at most "
        f"{shift_ms:.0f} ms from its timestamp (the true stamps are in the stamp.* columns)"
    )


def write_contract(dataset: Path, flights: Sequence[Path], config: ExportConfig) -> None:
    """Write the contract file of a policy trained on a dataset of these flights.

    Raises:
        DatasetError: a flight's meta.json cannot be read.
    """
    kind = "flight folder"
    metas = [read_object(flight / "meta.json", DatasetError, kind) for flight in flights]
    contracts = [meta.get("contract") for meta in metas]
    # The only camera is the vehicle's own under any name: the contract's default.
    entries = [
        *(entry for entry in dataset_entries(dataset) if entry.name != "cameras"),
        *recorded_entries([each for each in contracts if isinstance(each, dict)]),
        Entry("task", "prompt", config.task, "--task"),
    ]
    title = (
        "Contract of the policies that are trained on this dataset, written by mavbridge export: "
        "mavbridge --policy lerobot:DIR --contract THIS_FILE"
    )
    (dataset / CONTRACT_FILE).write_text(draft_text(title, entries))


def _decoded(episode: FlightData, on_frame: Callable[[], None]) -> Iterator[ImageArray]:
    for image in episode.decode():
        on_frame()
        yield image


@contextmanager
def _whole_or_nothing(out: Path) -> Iterator[Path]:
    """Context manager: a folder beside ``out`` that is renamed to ``out`` when complete.

    Raises:
        UserError: ``out`` is not empty, or cannot be written.
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
