"""Settings of training, each a flag of a command, and the stages of a run.

First the encoder learns. A policy's encoder learns together with its head, on images that grow from
stage to stage: the encoders are fully convolutional, and a small image costs a fraction. A world
model's encoder learns alone. Then the encoder is frozen, each image is encoded once, and the rest
learns from the stored features, about ten times as many steps.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from policy.errors import PolicyError

Precision = Literal["auto", "bf16", "f32"]
DEFAULT_MINUTES = 45.0
MAX_AGE_MS = 1000

_RANGES: dict[str, tuple[float, float]] = {
    "minutes": (0.01, 100_000),
    "steps": (1, 10**9),
    "image_size": (32, 1024),
    "batch_size": (2, 4096),
    "learning_rate": (0, 1e30),
    "weight_decay": (0, 1),
    "ema_decay": (0, 1),
    "seed": (0, 2**63 - 1),
    "validation_fraction": (0, 0.9),
    "validations": (1, 10_000),
    "repeats": (1, 100),
    "head_batch_size": (1, 100_000),
    "gate_weight": (0, 10_000),
    "check_flights": (0, 10_000),
    "check_every": (1, 10_000),
    "window_batch_size": (1, 4096),
    "autoencoder_share": (0.01, 0.99),
    "decision_share": (0, 1),
}


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Settings of every training run."""

    out: Path
    """Checkpoint to write (.safetensors); an unfinished run is kept beside it."""
    minutes: float | None = None
    """Length of the training; 45 if neither this nor --steps is given."""
    steps: int | None = None
    """Length of the training in optimiser steps, in place of --minutes."""
    image_size: int = 224
    """Pixels along a side of the images that the encoder takes."""
    batch_size: int = 32
    """Images a step while the encoder learns."""
    learning_rate: float = 1e-3
    """Peak learning rate of AdamW."""
    weight_decay: float = 0.02
    """Weight decay of AdamW."""
    ema_decay: float = 0.999
    """Decay of the moving average of the weights, which is what gets exported."""
    mirror: bool = True
    """Mirror half of the samples; --no-mirror for a camera that does not look straight ahead."""
    seed: int = 0
    """Seed of weights, order and noise."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1."""
    precision: Precision = "auto"
    """Number format of the computation; auto takes bf16 where the hardware multiplies it."""
    resume: bool = False
    """Continue the unfinished run of --out."""
    validation_fraction: float = 0.1
    """Share of the flights that are held out."""
    validations: int | None = None
    """Validations in the run, evenly spaced, each of which also saves the state of the run; one
    every two minutes or fifty steps, 4 to 20, if not given."""
    include_failed: bool = False
    """Learn from flights, too, that crashed, were marked as bad, or missed gates."""
    camera_key: str | None = None
    """Camera of a LeRobot dataset that has several, e.g. observation.images.front."""

    def __post_init__(self) -> None:
        if self.out.suffix != ".safetensors":
            raise PolicyError(f"--out {self.out}: checkpoints are written as .safetensors")
        if self.minutes is not None and self.steps is not None:
            raise PolicyError("--minutes and --steps contradict each other: give one of them")
        for name, value in vars(self).items():
            low, high = _RANGES.get(name, (None, None))
            if value is None or low is None or high is None or low <= value <= high:
                continue
            flag = name.replace("_", "-")
            raise PolicyError(f"--{flag} must be between {low:g} and {high:g}, got {value:g}")

    def fraction(self, step: int, spent_s: float) -> float:
        """Return the used share of the budget after this number of steps and seconds, 0 to 1."""
        if self.steps is not None:
            return min(step / self.steps, 1.0)
        return min(spent_s / (60.0 * (self.minutes or DEFAULT_MINUTES)), 1.0)

    @property
    def validation_count(self) -> int:
        """Number of validations in the run."""
        if self.validations is not None:
            return self.validations
        due = (self.minutes or DEFAULT_MINUTES) / 2 if self.steps is None else self.steps / 50
        return max(4, min(20, int(due)))

    @property
    def work_folder(self) -> Path:
        """Folder of an unfinished run."""
        return self.out.with_name(self.out.stem + ".training")


@dataclass(frozen=True, kw_only=True)
class TrainSettings(RunSettings):
    """Settings of the training of a policy."""

    policy: str = "toge"
    """toge[:small|medium|large][:BACKBONE] or resnet-unet[:SIZE]."""
    since_exposure: bool = True
    """Give the policy its image's age and the motion since; --no-since-exposure to leave it out."""
    ages: str | None = None
    """Image ages to train for: the flight folder that they were measured in, or LOW:HIGH in ms; by
    default those measured in the flights, or 20 to 90 ms where no policy flew."""
    start_from: Path | None = None
    """Checkpoint to start from, e.g. after more flights were added."""
    freeze_encoder: bool = False
    """Train the head alone, on the features of the encoder of --start-from."""
    backbone_weights: Path | None = None
    """torchvision's ImageNet weights of the encoder (.pth)."""
    repeats: int = 2
    """Moments after its exposure for which an encoded image is used in a step."""
    head_batch_size: int = 256
    """Samples a step while the head learns alone."""
    gate_weight: float = 100.0
    """Weight of the loss of gate positions that are read off the feature, in flights that hold
    them; 0 = off. The sticks of a few flights alone teach an encoder those flights' courses."""
    disturb: bool = True
    """Recolour images, light them unevenly, veil and cover them, each a quarter, while the encoder
    learns; --no-disturb where brightness or colour is what the policy is to look at."""
    pack: bool = False
    """Write a checkpoint to ship, a third of the size: the encoder in int8, the rest in float16."""
    check_flights: int = 0
    """Courses to fly with the weights now and then; those that fly best are kept, not those with
    the least loss. Takes the extra "sitl"."""
    check_courses: Literal["easy", "race"] = "easy"
    """Family of those courses."""
    check_every: int = 5
    """Validations between two such checks."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.start_from is not None and self.backbone_weights is not None:
            raise PolicyError("--start-from holds an encoder: leave out --backbone-weights")
        if self.freeze_encoder and self.start_from is None:
            raise PolicyError("--freeze-encoder needs a trained one: give --start-from CHECKPOINT")
        _ = self.age_range_ms

    @property
    def age_range_ms(self) -> tuple[float, float] | None:
        """Return the range of ``--ages LOW:HIGH``; None if it names a flight or is not set."""
        if self.ages is None or ":" not in self.ages or Path(self.ages).is_dir():
            return None
        low, _, high = self.ages.partition(":")
        try:
            low_ms, high_ms = float(low), float(high)
        except ValueError:
            low_ms, high_ms = math.nan, math.nan
        if not 0 < low_ms <= high_ms <= MAX_AGE_MS:
            raise PolicyError(
                f"--ages {self.ages} is neither a flight folder nor LOW:HIGH with 0 < LOW <= HIGH "
                f"<= {MAX_AGE_MS} ms"
            )
        return low_ms, high_ms


@dataclass(frozen=True, kw_only=True)
class WorldModelSettings(RunSettings):
    """Settings of the training of a world model."""

    image_size: int = 64
    """Pixels along a side of the frames."""
    batch_size: int = 8
    """Frames a step while the autoencoder learns."""
    learning_rate: float = 2e-3
    """Peak learning rate of AdamW."""
    window_batch_size: int = 8
    """Windows a step while the dynamics learns."""
    start_from: Path | None = None
    """World model whose autoencoder is kept as it is; the dynamics learns anew."""
    autoencoder_share: float = 0.25
    """Share of the run in which the autoencoder learns, unless it is kept."""
    decision_share: float = 0.3
    """Share of the windows in which the model has to find the actions."""


_SIZES = ((3 / 7, 0.35, 0.20), (5 / 7, 0.30, 0.15), (1.0, 0.10, 0.10))
"""Image size relative to the full one, share of time, share of steps; the head gets the rest."""
MIN_IMAGE_SIZE = 96
"""Below this size, an image costs a CPU hardly less."""


@dataclass(frozen=True)
class TrainingStage:
    """Part of a run, between two fractions of its budget."""

    name: str
    start: float
    end: float
    image_size: int
    """Pixels along a side."""
    trains_encoder: bool
    is_scored: bool
    """Its weights may be exported."""


def policy_stages(settings: TrainSettings) -> tuple[TrainingStage, ...]:
    """Return the stages of a policy's training, in order; they fill the budget."""
    full, shares = settings.image_size, dict[int, float]()
    if not settings.freeze_encoder:
        for wanted, of_time, of_steps in _SIZES:
            scale = max(wanted, min(MIN_IMAGE_SIZE / full, 1.0))
            # Below the full size, a multiple of 32, the stride of all encoders.
            size = full if scale == 1.0 else min(full, round(full * scale / 32) * 32)
            share = of_time if settings.steps is None else of_steps
            shares[size] = shares.get(size, 0.0) + share
    stages, start = [], 0.0
    for size, share in shares.items():
        name, is_scored = f"encoder and head, {size}x{size}", size == full
        stages.append(TrainingStage(name, start, start + share, size, True, is_scored))
        start += share
    return (*stages, TrainingStage("head", start, 1.0, full, False, True))


def world_model_stages(settings: WorldModelSettings) -> tuple[TrainingStage, ...]:
    """Return the stages: autoencoder, unless an existing one is kept, then dynamics."""
    turn, size = settings.autoencoder_share, settings.image_size
    if settings.start_from is not None:
        return (TrainingStage("dynamics", 0.0, 1.0, size, False, True),)
    return (
        TrainingStage("autoencoder", 0.0, turn, size, True, False),
        TrainingStage("dynamics", turn, 1.0, size, False, True),
    )


def learning_rate_factor(progress: float) -> float:
    """Return a linear warm-up over the first twentieth, then half a cosine down to a hundredth."""
    warm_up = 0.05
    if progress < warm_up:
        return max(progress / warm_up, 0.01)
    along = min((progress - warm_up) / (1 - warm_up), 1.0)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * along))
