"""A killed training that goes on must end where one that was not killed ends."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import pytest
from safetensors import safe_open

from policy.data.episodes import Episode
from policy.training.report import Progress, TrainResult
from policy.training.state import TrainingError, TrainingStoppedError


class Training(Protocol):
    """One run over flights; what is not resumed must not be there yet."""

    def __call__(
        self,
        episodes: list[Episode],
        *,
        resume: bool = False,
        report: Callable[[Progress], None] = lambda _: None,
        should_stop: Callable[[], bool] = lambda: False,
    ) -> TrainResult:
        """Train to the end, or until ``report`` raises or ``should_stop`` says so."""
        ...


def check_resuming(
    train: Training, episodes: list[Episode], whole: TrainResult, *, killed_at: int
) -> None:
    """Kill it after the validation of a step; refuse to begin anew or with others; go on."""

    def kill(progress: Progress) -> None:
        if progress.validation is not None and progress.step == killed_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(episodes, report=kill)
    with pytest.raises(TrainingError, match="--resume"):
        train(episodes)
    with pytest.raises(TrainingError, match="other flights or settings"):
        train(episodes[:2], resume=True)
    check_same(train(episodes, resume=True), whole)


def check_stopping(
    train: Training, episodes: list[Episode], whole: TrainResult, *, validated_at: int
) -> None:
    """Stop it a step after a validation, and go on."""
    polls_left: int | None = None

    def wait(progress: Progress) -> None:
        nonlocal polls_left
        if progress.validation is not None and progress.step == validated_at:
            polls_left = 2

    def is_over() -> bool:
        nonlocal polls_left
        polls_left = None if polls_left is None else polls_left - 1
        return polls_left == 0

    with pytest.raises(TrainingStoppedError, match="--resume"):
        train(episodes, report=wait, should_stop=is_over)
    check_same(train(episodes, resume=True), whole)


def check_same(result: TrainResult, whole: TrainResult) -> None:
    """All but the name of the checkpoint."""
    assert result == replace(whole, checkpoint=result.checkpoint)
    assert weights_of(result.checkpoint) == weights_of(whole.checkpoint)


def weights_of(path: Path) -> dict[str, bytes]:
    """Every tensor of a checkpoint, as it lies in the file."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name).numpy().tobytes() for name in file.keys()}  # noqa: SIM118
