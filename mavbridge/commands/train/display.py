"""Progress and result of a training run, for a person."""

import sys
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from policy.training.report import TrainingProgress, TrainResult


class Display:
    """A progress bar where there is a terminal, a line now and then where there is none."""

    def __init__(self) -> None:
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TaskProgressColumn(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[losses]}"),
            console=Console(file=sys.stderr, highlight=False),
        )
        self._task = self._bar.add_task("starting", total=1.0, losses="")

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def show(self, progress: TrainingProgress) -> None:
        """Show whatever the run reports."""
        if progress.note is not None:
            self._bar.print(f"note: {progress.note}")
            return
        self._bar.update(self._task, description=progress.stage, completed=progress.fraction)
        if progress.losses is not None:
            parts = (f"{name} {value:.3f}" for name, value in progress.losses.items())
            losses = f"step {progress.step}  {'  '.join(parts).replace('_', ' ')}"
            self._bar.update(self._task, losses=losses)
        if progress.validation is not None:
            self._bar.print(
                f"{progress.fraction:4.0%} {progress.stage}, step {progress.step}: "
                f"{progress.validation.describe()}"
            )


def print_result(result: TrainResult) -> None:
    """Print where the checkpoint is, and how good it is."""
    console = Console(highlight=False)
    console.print(f"{result.checkpoint}: {result.steps} steps", soft_wrap=True)
    if result.validation is not None:
        console.print(result.validation.describe(), soft_wrap=True)
    if result.score is not None:
        console.print(f"closed-loop score {result.score:.3f}")
