"""Reports of a training run, and hooks to watch and stop it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias


@dataclass(frozen=True, kw_only=True)
class PolicyValidation:
    """Errors of a policy on held-out flights."""

    loss: float
    gate_loss: float
    stick_error: float
    """Mean absolute error of the sampled sticks, in full deflections."""
    mean_stick_error: float
    """Error of always flying the mean stick of the training flights."""
    hold_error: float | None
    """Error of holding the newest stick of the history; None by rates, without sent sticks."""

    @property
    def selected_by(self) -> float:
        """Figure of which the lowest is kept: the error of what flies."""
        return self.stick_error

    def describe(self) -> str:
        """Return one line for the user."""
        held = "" if self.hold_error is None else f", last stick held {self.hold_error:.3f}"
        return (
            f"held-out loss {self.loss:.3f}, stick error {self.stick_error:.3f} of full deflection "
            f"(mean stick {self.mean_stick_error:.3f}{held})"
        )


@dataclass(frozen=True, kw_only=True)
class WorldModelValidation:
    """Errors of a world model on held-out flights."""

    loss: float
    reconstruction_psnr_db: float
    """PSNR of encoded and decoded frames: the upper limit for imagined ones."""
    psnr_db: float
    """PSNR of imagined frames, all of a future."""
    copy_psnr_db: float
    """PSNR of repeating the last frame."""
    velocity_error_mps: float
    """Mean length of the velocity error in the last imagined state."""
    held_velocity_error_mps: float
    """Mean length of the velocity error if the velocity is held constant."""

    @property
    def selected_by(self) -> float:
        """Figure of which the lowest is kept."""
        return self.loss

    def describe(self) -> str:
        """Return one line for the user."""
        return (
            f"held-out loss {self.loss:.4f}, frames coded to {self.reconstruction_psnr_db:.1f} dB, "
            f"imagined to {self.psnr_db:.1f} dB (last frame copied {self.copy_psnr_db:.1f} dB), "
            f"velocity at the end off by {self.velocity_error_mps:.2f} m/s (held "
            f"{self.held_velocity_error_mps:.2f} m/s)"
        )


Validation: TypeAlias = PolicyValidation | WorldModelValidation


@dataclass(frozen=True, kw_only=True)
class TrainingProgress:
    """Progress for the user, a few times a minute."""

    stage: str
    fraction: float
    """Used share of the whole budget."""
    step: int
    losses: Mapping[str, float] | None = None
    """Means over the last steps, by name."""
    validation: Validation | None = None
    note: str | None = None


@dataclass(frozen=True, kw_only=True)
class Hooks:
    """Clock, progress callback and stop request of a run."""

    now_s: Callable[[], float]
    """Monotonic seconds, for a time budget."""
    report: Callable[[TrainingProgress], None] = lambda _: None
    should_stop: Callable[[], bool] = lambda: False
    """Polled after every step; True stops the run, which keeps its best weights."""


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """Result of a finished run."""

    checkpoint: Path
    steps: int
    validation: Validation | None
    """Validation of the exported weights; None if no flights were held out."""
