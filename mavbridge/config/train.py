"""Settings of ``mavbridge train``."""

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.courses import MAX_EPISODES
from mavbridge.core.errors import UserError


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class TrainConfig:
    """One training run."""

    out: Path | None = None
    """Checkpoint to write (.safetensors); an unfinished run is kept beside it."""
    policy: str = "toge"
    """toge[:small|medium|large][:BACKBONE], resnet-unet[:SIZE], or world-model."""
    image_size: int | None = None
    """Pixels a side into the encoder; 224, or 64 for a world model, if not given."""
    minutes: float | None = None
    """How long to train; 45 if neither this nor --steps is given."""
    steps: int | None = None
    """How many optimiser steps to train, in place of --minutes."""
    batch_size: int | None = None
    """Images a step while the encoder learns; 32, or 8 for a world model, if not given."""
    seed: int = 0
    """Of weights, order and noise."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1."""
    resume: bool = False
    """Go on with the unfinished run of --out."""
    validation_fraction: float = 0.1
    """Share of the flights that are held out."""
    ages: str | None = None
    """Image ages to train for: the flight folder that they were measured in, or LOW:HIGH in ms; by
    default those measured in the flights."""
    camera_key: str | None = None
    """Camera of a LeRobot dataset that has several, e.g. observation.images.front."""
    start_from: Path | None = None
    """Checkpoint to go on from, e.g. after more flights were added. Of a world model only the
    autoencoder can be kept: give --freeze-encoder too."""
    freeze_encoder: bool = False
    """Train the head alone, on what the encoder of --start-from makes of the images; for a world
    model, the dynamics alone and anew."""
    backbone_weights: Path | None = None
    """torchvision's ImageNet weights of the encoder (.pth)."""
    pack: bool = False
    """Write a checkpoint to ship, a third of the size: the encoder in int8, the rest in float16."""
    check_flights: int = 0
    """Courses to fly with the weights now and then; the best in flight are kept, not those with the
    least loss. Takes the extra "sitl"."""
    mirror: bool = True
    """Mirror half of the samples; --no-mirror for a camera that does not look straight ahead."""
    since_exposure: bool = True
    """Tell the policy its image's age and how it moved since; --no-since-exposure to leave out."""
    gate_weight: float = 100.0
    """Weight of the loss that asks the encoder for the gates, in flights that know; 0 = off."""

    def __post_init__(self) -> None:
        """Refuse values that no run could use."""
        if self.minutes is not None and self.steps is not None:
            raise UserError("--minutes and --steps contradict each other: give one of them")
        if self.image_size is not None:
            check_range("image-size", self.image_size, 32, 1024, "pixels")
        if self.batch_size is not None:
            check_range("batch-size", self.batch_size, 2, 4096, "")
        check_range("seed", self.seed, 0, 2**63 - 1, "")
        check_range("validation-fraction", self.validation_fraction, 0, 0.9, "")
        check_range("gate-weight", self.gate_weight, 0, 10_000, "")
        check_range("check-flights", self.check_flights, 0, MAX_EPISODES, "")
        if self.minutes is not None:
            check_range("minutes", self.minutes, 0.01, 100_000, "minutes")
        if self.steps is not None:
            check_range("steps", self.steps, 1, 10**9, "steps")
