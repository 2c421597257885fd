"""The whole of ``mavbridge demonstrate``: many flights into one folder, resumable."""

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from shutil import rmtree

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from mavbridge.commands.demonstrate.flight import Outcome, demonstrate_once
from mavbridge.config.demonstrate import DemonstrateConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import UserError
from mavbridge.core.stopping import INTERRUPTED, stop_on_signals
from mavbridge.flight.policies import load_for_episodes
from mavbridge.recording.folder import META, prepare_folder
from mavbridge.recording.meta import FlightError, read_meta
from policy.contract import Contract


@dataclass(frozen=True, kw_only=True)
class _Job:
    folder: Path
    seed: int
    config: DemonstrateConfig


def demonstrate(config: DemonstrateConfig) -> int:
    """Fly what is missing of the episodes; 130 if interrupted, to be gone on with later.

    Raises:
        MavbridgeError, PolicyError: for whatever a person can have caused.
    """
    console = Console(stderr=True, emoji=False)
    jobs = _missing(config)
    done = config.episodes - len(jobs)
    if done:
        console.print(Text(f"{done} of {config.episodes} are there already", style="dim"))
    succeeded = 0
    with stop_on_signals() as stop, _progress(console) as progress:
        bar = progress.add_task("demonstrating", total=config.episodes, completed=done, score="")
        outcomes = _fly(jobs, config.workers, stop.is_set)
        for flown, outcome in enumerate(outcomes, start=1):
            succeeded += outcome.success
            progress.update(bar, advance=1, score=f"{succeeded} of {flown} finished the course")
        was_stopped = stop.is_set()
    if was_stopped:
        console.print(Text("interrupted: the same command goes on from here", style="yellow"))
        return INTERRUPTED
    return 0


def _progress(console: Console) -> Progress:
    return Progress(
        TextColumn("demonstrating"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[score]}"),
        TimeRemainingColumn(),
        console=console,
    )


def _missing(config: DemonstrateConfig) -> list[_Job]:
    """The episodes that are not there whole; what is left of an unfinished one is removed.

    Raises:
        UserError: a folder in the way that is no flight.
    """
    jobs = []
    for index in range(config.episodes):
        folder = config.out / f"{index:06d}"
        if folder.is_dir() and any(folder.iterdir()):
            if not (folder / META).is_file():
                raise UserError(f"{folder} is no recorded flight: name another --out")
            if _is_whole(folder):
                continue
            rmtree(folder)
        seed = config.first_course_seed + index
        jobs.append(_Job(folder=folder, seed=seed, config=config))
    return jobs


def _is_whole(folder: Path) -> bool:
    try:
        return read_meta(folder).finished
    except FlightError:
        return False


def _fly(jobs: list[_Job], workers: int, should_stop: Callable[[], bool]) -> Iterator[Outcome]:
    if workers == 1 or len(jobs) < 2:
        for job in jobs:
            if should_stop():
                return
            yield _fly_job(job)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_leave_signals) as pool:
        futures: list[Future[Outcome]] = [pool.submit(_fly_job, job) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
                if should_stop():
                    return
        finally:
            pool.shutdown(wait=True, cancel_futures=True)


def _leave_signals() -> None:
    """A Ctrl-C goes to the whole group: the workers finish the flight that they are at."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _fly_job(job: _Job) -> Outcome:
    prepare_folder(job.folder)
    config = job.config
    student = None
    contract = Contract(feature_dim=1, arrays="numpy")
    if config.policy.checkpoint is not None:
        student = load_for_episodes(
            replace(config.policy, dual_rate=True), MonotonicClock()
        ).executable
        contract = student.contract
    elif config.policy.image_size is not None:
        size = config.policy.image_size
        contract = replace(contract, image_height=size, image_width=size)
    return demonstrate_once(
        job.folder,
        job.seed,
        speed_mps=config.speed,
        max_time_s=config.max_time,
        contract=contract,
        student=student,
    )
