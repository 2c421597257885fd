"""A killed training that goes on must end where one that was not killed ends."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import pytest
from safetensors import safe_open

from policy.dataset import Episode
from policy.train_report import Progress, TrainResult
from policy.train_state import TrainingError


class Training(Protocol):
    """One run over flights; what is not resumed must not be there yet."""

    def __call__(
        self,
        episodes: list[Episode],
        *,
        resume: bool = False,
        report: Callable[[Progress], None] = lambda _: None,
    ) -> TrainResult:
        """Train to the end, or until ``report`` raises."""
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
    resumed = train(episodes, resume=True)
    assert resumed == replace(whole, checkpoint=resumed.checkpoint)
    assert weights_of(resumed.checkpoint) == weights_of(whole.checkpoint)


def weights_of(path: Path) -> dict[str, bytes]:
    """Every tensor of a checkpoint, as it lies in the file."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name).numpy().tobytes() for name in file.keys()}  # noqa: SIM118
