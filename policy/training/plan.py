"""What to train, how long, and in which stages.

First encoder and head learn together, on images that grow from stage to stage: the encoders are
fully convolutional, and a small image costs a fraction. Then the encoder stands still, each image
is encoded once, and the head alone learns from the kept features: some ten times the steps.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Literal, TypeAlias

from policy.data.episodes import Nanoseconds
from policy.errors import PolicyError
from policy.nets.resnet_unet import ResnetUnetConfig
from policy.nets.toge import TogeConfig
from policy.world_model.config import WorldModelConfig

Precision = Literal["auto", "bf16", "f32"]
Check: TypeAlias = Callable[[Path], float]
"""Flies a checkpoint and says how well: more is better."""

_SMALLER = ((3 / 7, 0.35, 0.20), (5 / 7, 0.30, 0.15), (1.0, 0.10, 0.10))
"""Image size over the full one, share of the time, share of the steps; the head has the rest."""
MIN_IMAGE_SIZE = 96
"""Below it, an image costs a CPU hardly less."""


@dataclass(frozen=True, kw_only=True)
class Span:
    """A part of a run, between two fractions of its budget."""

    name: str
    start: float
    end: float


@dataclass(frozen=True, kw_only=True)
class Stage(Span):
    """A part of a policy's training."""

    image_size: tuple[int, int]
    """Height and width, px."""
    trains_encoder: bool


@dataclass(frozen=True, kw_only=True)
class Budget:
    """Optimiser steps or seconds, one of them.

    Raises:
        PolicyError: neither, both, or less than one.
    """

    steps: int | None = None
    seconds: float | None = None

    def __post_init__(self) -> None:
        """Refuse a run without an end."""
        if (self.steps is None) == (self.seconds is None):
            raise PolicyError("give either --minutes or --steps")
        if self.steps is not None and self.steps < 1:
            raise PolicyError(f"--steps must be 1 or more, got {self.steps}")
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise PolicyError(f"--minutes must be more than 0, got {self.seconds / 60:g}")

    def fraction(self, step: int, spent_s: float) -> float:
        """How much of it is used, 0 to 1."""
        if self.steps is not None:
            return min(step / self.steps, 1.0)
        return min(spent_s / (self.seconds or 1.0), 1.0)


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """What every training run is told.

    Raises:
        PolicyError: a value is out of its range.
    """

    out: Path
    """The checkpoint; what a resumed run needs is kept beside it until the end."""
    budget: Budget
    batch_size: int = 32
    """Images a step while the encoder learns."""
    learning_rate: float = 1e-3
    """Peak of AdamW's."""
    weight_decay: float = 0.02
    ema_decay: float = 0.999
    mirror: bool = True
    """Half of the samples are mirrored: off for a camera that does not look straight ahead."""
    seed: int = 0
    device: str = "cpu"
    precision: Precision = "auto"
    resume: bool = False
    validation_fraction: float = 0.1
    """Flights held out."""
    validations: int | None = None
    """In a run, evenly spaced; the state of the run is kept at the same times. None = one every two
    minutes or fifty steps, 4 to 20."""

    def __post_init__(self) -> None:
        """Refuse what no run could do."""
        if self.batch_size < 2:
            raise PolicyError("--batch-size must be 2 or more: batch norm needs two images")
        if not 0 <= self.validation_fraction < 1:
            raise PolicyError(
                f"--validation-fraction must be in [0, 1), got {self.validation_fraction:g}"
            )
        if self.out.suffix != ".safetensors":
            raise PolicyError(f"--out {self.out}: checkpoints are written as .safetensors")

    @property
    def validation_count(self) -> int:
        """Validations in the run."""
        if self.validations is not None:
            return self.validations
        steps, seconds = self.budget.steps or 0, self.budget.seconds or 0.0
        return max(4, min(20, int(steps / 50 + seconds / 120)))

    @property
    def work_folder(self) -> Path:
        """Where an unfinished run lives."""
        return self.out.with_name(self.out.stem + ".training")


@dataclass(frozen=True, kw_only=True)
class TrainSettings(RunSettings):
    """The training of a policy.

    Raises:
        PolicyError: a value is out of its range.
    """

    policy: TogeConfig | ResnetUnetConfig
    """Its contract's ``state_frame`` must be the flights'."""
    repeats: int = 2
    """Moments after its exposure for which one encoded image is used."""
    head_batch_size: int = 256
    """Samples a step while the head learns alone."""
    gate_weight: float = 100.0
    """Of the loss that asks the feature for the gates; 0 = off. High, because the sticks of a few
    flights teach an encoder the courses of those flights, and not where gates are."""
    ages_ns: Nanoseconds | None = None
    """Measured ages of images to train for; None = those measured in the flights."""
    start_from: Path | None = None
    """A checkpoint of the same architecture; the learning rate is a third then."""
    freeze_encoder: bool = False
    """Leave the encoder of ``start_from`` as it is: all the time is the head's."""
    backbone_weights: Path | None = None
    """torchvision's state dict of the encoder, as .pth."""
    pack: bool = False
    """Write the checkpoint in a third of the bytes (``policy.checkpoints.packing``)."""
    check_every: int = 5
    """Validations between two calls of the closed-loop check."""

    def __post_init__(self) -> None:
        """Refuse what no run could do."""
        super().__post_init__()
        for name in ("repeats", "head_batch_size", "check_every"):
            if getattr(self, name) < 1:
                raise PolicyError(f"{name} must be 1 or more, got {getattr(self, name)}")
        if self.start_from is not None and self.backbone_weights is not None:
            raise PolicyError("--start-from holds an encoder: leave out --backbone-weights")
        if self.freeze_encoder and self.start_from is None:
            raise PolicyError("--freeze-encoder needs a trained one: give --start-from CHECKPOINT")


@dataclass(frozen=True, kw_only=True)
class WorldTrainSettings(RunSettings):
    """The training of a world model.

    Raises:
        PolicyError: a value is out of its range.
    """

    model: WorldModelConfig
    """Its contract's ``state_frame`` must be the flights'."""
    batch_size: int = 8
    """Frames a step while the autoencoder learns: a CPU is no faster with more at a time."""
    learning_rate: float = 2e-3
    window_batch_size: int = 8
    """Windows a step while the dynamics learns."""
    autoencoder_share: float = 0.25
    """Of the budget; the dynamics has the rest, or with ``autoencoder_of`` all of it."""
    autoencoder_of: Path | None = None
    """A world model whose autoencoder is kept as it is; the dynamics learns anew."""
    decision_share: float = 0.3
    """Of the windows, those in which the actions are to be found."""

    def __post_init__(self) -> None:
        """Refuse what no run could do."""
        super().__post_init__()
        if self.window_batch_size < 1:
            raise PolicyError(f"window_batch_size must be 1 or more, got {self.window_batch_size}")
        if not 0 < self.autoencoder_share < 1:
            raise PolicyError(f"autoencoder_share must be in (0, 1), got {self.autoencoder_share}")
        if not 0 <= self.decision_share <= 1:
            raise PolicyError(f"decision_share must be in [0, 1], got {self.decision_share}")

    @property
    def stages(self) -> tuple[Span, Span]:
        """Of the run, in order."""
        turn = self.autoencoder_share if self.autoencoder_of is None else 0.0
        return (
            Span(name="autoencoder", start=0.0, end=turn),
            Span(name="dynamics", start=turn, end=1.0),
        )


def make_stages(settings: TrainSettings) -> tuple[Stage, ...]:
    """The stages of a run, in order; they fill the budget."""
    contract = settings.policy.contract
    full = (contract.image_height, contract.image_width)
    if settings.freeze_encoder:
        return (Stage(name="head", image_size=full, trains_encoder=False, start=0.0, end=1.0),)
    shares: dict[tuple[int, int], float] = {}
    least = min(MIN_IMAGE_SIZE / min(full), 1.0)
    for wanted, of_time, of_steps in _SMALLER:
        scale = max(wanted, least)
        size = (_scaled(full[0], scale), _scaled(full[1], scale))
        share = of_time if settings.budget.steps is None else of_steps
        shares[size] = shares.get(size, 0.0) + share
    ends = list(accumulate(shares.values()))
    joint = [
        Stage(
            name=f"encoder and head, {width}x{height}",
            image_size=(height, width),
            trains_encoder=True,
            start=start,
            end=end,
        )
        for (height, width), start, end in zip(shares, (0.0, *ends), ends, strict=False)
    ]
    head = Stage(name="head", image_size=full, trains_encoder=False, start=ends[-1], end=1.0)
    return (*joint, head)


def learning_rate_factor(progress: float) -> float:
    """Linear warm-up over the first twentieth, then half a cosine down to a hundredth."""
    warm_up = 0.05
    if progress < warm_up:
        return max(progress / warm_up, 0.01)
    along = min((progress - warm_up) / (1 - warm_up), 1.0)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * along))


def _scaled(full: int, scale: float) -> int:
    """A multiple of 32, the stride of all encoders, where it is not the full size."""
    if scale == 1.0:
        return full
    return min(full, round(full * scale / 32) * 32)
