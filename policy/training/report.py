"""What a training run tells of itself."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias


@dataclass(frozen=True, kw_only=True)
class Validation:
    """How well a policy meets held-out flights."""

    loss: float
    gate_loss: float
    stick_error: float
    """Mean absolute error of the sampled sticks, in full deflections."""
    mean_stick_error: float
    """The same of always flying the mean stick of the training flights."""
    hold_error: float
    """The same of holding the newest stick of the history."""

    def describe(self) -> str:
        """For a person, in a line."""
        return (
            f"held-out loss {self.loss:.3f}, stick error {self.stick_error:.3f} of full deflection "
            f"(mean stick {self.mean_stick_error:.3f}, last stick held {self.hold_error:.3f})"
        )


@dataclass(frozen=True, kw_only=True)
class WorldValidation:
    """How well a world model foretells held-out flights."""

    loss: float
    reconstruction_psnr_db: float
    """Of frames that were encoded and decoded: the most that imagined ones can reach."""
    psnr_db: float | None = None
    """Of imagined frames, all of a future; None while only the autoencoder learns."""
    copy_psnr_db: float | None = None
    """The same of showing the last frame again."""
    velocity_error_mps: float | None = None
    """Of the last imagined state, mean length."""
    held_velocity_error_mps: float | None = None
    """The same of the velocity staying as it is."""

    def describe(self) -> str:
        """For a person, in a line."""
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


Held: TypeAlias = Validation | WorldValidation


@dataclass(frozen=True, kw_only=True)
class Progress:
    """For a person, a few times a minute."""

    stage: str
    fraction: float
    """Of the whole budget."""
    step: int
    losses: Mapping[str, float] | None = None
    """By name, means over the last steps."""
    validation: Held | None = None
    note: str | None = None


@dataclass(frozen=True, kw_only=True)
class TrainResult:
    """What came out."""

    checkpoint: Path
    steps: int
    validation: Held | None
    """Of the exported weights; None where nothing was held out."""
    score: float | None
    """Of the closed-loop check, if there was one."""


Report = Callable[[Progress], None]
