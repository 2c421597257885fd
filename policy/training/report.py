"""Reports of a training run, and the hooks by which it is watched and stopped."""

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
    """The same error if the mean stick of the training flights were always flown."""
    hold_error: float
    """The same error if the newest stick of the history were held."""

    def describe(self) -> str:
        """One line for a person."""
        return (
            f"held-out loss {self.loss:.3f}, stick error {self.stick_error:.3f} of full deflection "
            f"(mean stick {self.mean_stick_error:.3f}, last stick held {self.hold_error:.3f})"
        )


@dataclass(frozen=True, kw_only=True)
class WorldModelValidation:
    """Errors of a world model on held-out flights."""

    loss: float
    reconstruction_psnr_db: float
    """PSNR of frames that were encoded and decoded: the most that imagined ones can reach."""
    psnr_db: float | None = None
    """PSNR of imagined frames, all of a future; None while only the autoencoder learns."""
    copy_psnr_db: float | None = None
    """PSNR of showing the last frame again."""
    velocity_error_mps: float | None = None
    """Mean length of the velocity's error in the last imagined state."""
    held_velocity_error_mps: float | None = None
    """The same error if the velocity stayed as it is."""

    def describe(self) -> str:
        """One line for a person."""
        line = (
            f"held-out loss {self.loss:.4f}, frames coded to {self.reconstruction_psnr_db:.1f} dB"
        )
        if self.psnr_db is None:
            return line
        return (
            f"{line}, imagined to {self.psnr_db:.1f} dB (last frame copied {self.copy_psnr_db:.1f} "
            f"dB), velocity at the end off by {self.velocity_error_mps:.2f} m/s (held "
            f"{self.held_velocity_error_mps:.2f} m/s)"
        )


Validation: TypeAlias = PolicyValidation | WorldModelValidation


@dataclass(frozen=True, kw_only=True)
class TrainingProgress:
    """Progress for a person, a few times a minute."""

    stage: str
    fraction: float
    """Share of the whole budget that is used."""
    step: int
    losses: Mapping[str, float] | None = None
    """Means over the last steps, by name."""
    validation: Validation | None = None
    note: str | None = None


@dataclass(frozen=True, kw_only=True)
class Hooks:
    """Clock, progress and a request to stop, for a run."""

    now_s: Callable[[], float]
    """Monotonic seconds, for a budget in time."""
    report: Callable[[TrainingProgress], None] = lambda _: None
    should_stop: Callable[[], bool] = lambda: False
    """Polled after every step; True ends the run, to be resumed."""


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """Result of a finished run."""

    checkpoint: Path
    steps: int
    validation: Validation | None
    """Validation of the exported weights; None where nothing was held out."""
    score: float | None
    """Score of the closed-loop check, if there was one."""
