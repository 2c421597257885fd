"""Hooks of a training run on a made-up clock, and the weights that it wrote."""

from collections.abc import Callable
from itertools import count
from pathlib import Path

from safetensors import safe_open

from policy.training.report import Hooks, TrainingProgress


def make_hooks(
    report: Callable[[TrainingProgress], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Hooks:
    """Make hooks with a clock that advances by a tenth of a second at every reading."""
    ticking = count()
    return Hooks(now_s=lambda: next(ticking) * 0.1, report=report, should_stop=should_stop)


def weights_of(path: Path) -> dict[str, bytes]:
    """Return every tensor of a checkpoint, as stored in the file."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name).numpy().tobytes() for name in file.keys()}  # noqa: SIM118
