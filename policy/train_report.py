"""What a training run tells of itself."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Validation:
    """How well held-out flights are met."""

    loss: float
    gate_loss: float
    stick_error: float
    """Mean absolute error of the sampled sticks, in full deflections."""
    mean_stick_error: float
    """The same of always flying the mean stick of the training flights."""
    hold_error: float
    """The same of holding the newest stick of the history."""


@dataclass(frozen=True, kw_only=True)
class Progress:
    """For a person, a few times a minute."""

    stage: str
    fraction: float
    """Of the whole budget."""
    step: int
    loss: float | None = None
    gate_loss: float | None = None
    validation: Validation | None = None
    note: str | None = None


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """What came out."""

    checkpoint: Path
    steps: int
    validation: Validation | None
    """Of the exported weights; None where nothing was held out."""
    score: float | None
    """Of the closed-loop check, if there was one."""


Report = Callable[[Progress], None]
