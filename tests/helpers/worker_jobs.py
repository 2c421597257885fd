"""Jobs for worker processes, which import this module."""

import os
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from mavbridge.core.clock import NS_PER_MS, MonotonicClock
from mavbridge.simulation.referee import EpisodeInterruptedError


@dataclass(frozen=True, kw_only=True)
class Job:
    """Job that returns ``number``, after its side effects."""

    number: int
    deaths: int = 0
    """Workers to kill first; counted by files in ``folder``."""
    folder: Path | None = None
    error: Exception | None = None
    waits_for_stop: bool = False
    gets_ctrl_c: bool = False
    """True if it gets Ctrl-C, as every process of a terminal does."""
    kills_parent: bool = False

    def __str__(self) -> str:
        return f"job {self.number}"


def run(job: Job, should_stop: Callable[[], bool]) -> int:
    if job.folder is not None and len(list(job.folder.iterdir())) < job.deaths:
        (job.folder / str(os.getpid())).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    if job.kills_parent:
        os.kill(os.getppid(), signal.SIGKILL)
    if job.gets_ctrl_c:
        signal.raise_signal(signal.SIGINT)
    if job.error is not None:
        raise job.error
    clock = MonotonicClock()
    while job.waits_for_stop:
        if should_stop():
            raise EpisodeInterruptedError(f"{job}: interrupted")
        clock.sleep_until_ns(clock.now_ns() + 10 * NS_PER_MS)
    return job.number
