"""Checks that a killed and resumed training ends like an uninterrupted one."""

from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Protocol

import pytest
from safetensors import safe_open

from policy.data.flight_data import FlightData
from policy.training.report import Hooks, TrainingProgress, TrainResult
from policy.training.run_folder import TrainingError, TrainingStoppedError


class Training(Protocol):
    """One run over flights, always in one folder."""

    def __call__(
        self, flights: list[FlightData], hooks: Hooks, *, resume: bool = False
    ) -> TrainResult:
        """Train to the end, or until a hook raises or stops it."""
        ...


def make_hooks(
    report: Callable[[TrainingProgress], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Hooks:
    """Make hooks with a clock that advances by a tenth of a second at every reading."""
    ticking = count()
    return Hooks(now_s=lambda: next(ticking) * 0.1, report=report, should_stop=should_stop)


def check_resuming(
    train: Training, flights: list[FlightData], whole: TrainResult, *, killed_at: int
) -> None:
    """Kill it after a validation; check that it refuses a fresh start and other flights; resume."""

    def kill(progress: TrainingProgress) -> None:
        if progress.validation is not None and progress.step == killed_at:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(flights, make_hooks(kill))
    with pytest.raises(TrainingError, match="--resume"):
        train(flights, make_hooks())
    with pytest.raises(TrainingError, match="other flights or settings"):
        train(flights[:2], make_hooks(), resume=True)
    check_same(train(flights, make_hooks(), resume=True), whole)


def check_stopping(
    train: Training, flights: list[FlightData], whole: TrainResult, *, validated_at: int
) -> None:
    """Stop it a step after a validation, and resume."""
    polls_left: int | None = None

    def wait(progress: TrainingProgress) -> None:
        nonlocal polls_left
        if progress.validation is not None and progress.step == validated_at:
            polls_left = 2

    def should_stop() -> bool:
        nonlocal polls_left
        polls_left = None if polls_left is None else polls_left - 1
        return polls_left == 0

    with pytest.raises(TrainingStoppedError, match="--resume"):
        train(flights, make_hooks(wait, should_stop))
    check_same(train(flights, make_hooks(), resume=True), whole)


def check_same(result: TrainResult, whole: TrainResult) -> None:
    """Compare everything except for the names of the checkpoints."""
    assert result == replace(whole, checkpoint=result.checkpoint)
    assert weights_of(result.checkpoint) == weights_of(whole.checkpoint)


def weights_of(path: Path) -> dict[str, bytes]:
    """Return every tensor of a checkpoint, as stored in the file."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name).numpy().tobytes() for name in file.keys()}  # noqa: SIM118
