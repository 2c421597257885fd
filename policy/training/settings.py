"""Settings of training, each a flag of a command, and the stages of a run.

First the encoder learns: a policy's together with its head, a world model's alone. Then the encoder
is frozen, each image is encoded once, and the rest learns from the stored features, about ten times
as many steps.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

from policy.errors import PolicyError
from policy.fields import Between, field_kinds

Precision = Literal["auto", "bf16", "f32"]
DEFAULT_MINUTES = 45.0
MAX_AGE_MS = 1000


@dataclass(frozen=True, kw_only=True)
class RunSettings:
    """Settings of every training run."""

    out: Path
    """Checkpoint to write (.safetensors); the log of the run is kept beside it."""
    minutes: Annotated[float | None, Between(0.01, 100_000)] = None
    """Length of the training, without decoding and encoding the images; 45 if neither this nor
    --steps is given."""
    steps: Annotated[int | None, Between(1, 10**9)] = None
    """Length of the training in optimiser steps, in place of --minutes."""
    image_size: Annotated[int, Between(32, 1024)] = 96
    """Pixels along a side of the images that the encoder takes."""
    batch_size: Annotated[int, Between(2, 4096)] = 32
    """Images a step while the encoder learns."""
    learning_rate: Annotated[float, Between(0, 1e30)] = 1e-3
    """Peak learning rate of AdamW."""
    weight_decay: Annotated[float, Between(0, 1)] = 0.02
    """Weight decay of AdamW."""
    ema_decay: Annotated[float, Between(0, 1)] = 0.999
    """Decay of the moving average of the weights, which is what gets exported."""
    mirror: bool = True
    """Mirror half of the samples; --no-mirror for a camera that does not look straight ahead."""
    seed: Annotated[int, Between(0, 2**63 - 1)] = 0
    """Seed of weights, order and noise."""
    device: str = "cpu"
    """torch device: cpu, cuda, cuda:1."""
    precision: Precision = "auto"
    """Number format of the computation; auto takes bf16 where the hardware multiplies it."""
    validation_fraction: Annotated[float, Between(0, 0.9)] = 0.1
    """Share of the flights that are held out; those of one course stay together."""
    validations: Annotated[int | None, Between(1, 10_000)] = None
    """Validations in the run, evenly spaced; one every two minutes or fifty steps, 4 to 20, if not
    given."""
    include_failed: bool = False
    """Also flights that crashed, were cut off, ended by a fault, were marked as bad, or missed
    gates."""
    camera_key: str | None = None
    """Which of several cameras, e.g. front, or observation.images.front in LeRobot."""

    def __post_init__(self) -> None:
        if self.out.suffix != ".safetensors":
            raise PolicyError(f"--out {self.out}: checkpoints are written as .safetensors")
        if self.minutes is not None and self.steps is not None:
            raise PolicyError("--minutes and --steps contradict each other: give one of them")
        for name, (_, limits) in field_kinds(type(self)).items():
            value, flag = getattr(self, name), name.replace("_", "-")
            if limits is not None and value is not None and not limits.holds(value):
                told = f"between {limits.low:g} and {limits.high:g}"
                raise PolicyError(f"--{flag} must be {told}, got {value:g}")

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
        """Folder of the log, and of the decoded images while the run lasts."""
        return self.out.with_name(self.out.stem + ".training")


@dataclass(frozen=True, kw_only=True)
class TrainSettings(RunSettings):
    """Settings of the training of a policy."""

    policy: str = "toge"
    """toge[:small|medium|large][:BACKBONE]."""
    since_exposure: bool = True
    """Give the policy its image's age and the motion since; --no-since-exposure to leave it out."""
    ages: str | None = None
    """Image ages to train for: the flight folder that they were measured in, or LOW:HIGH in ms; by
    default those measured in the flights, or 20 to 90 ms where no policy flew."""
    start_from: Path | None = None
    """Checkpoint to start from, e.g. after more flights were added."""
    only_end: bool = False
    """Learn only what follows the last gate. Before it, --start-from is imitated in place of the
    pilot, and its encoder stays as it is: the policy flies the gates as before."""
    repeats: Annotated[int, Between(1, 100)] = 2
    """Moments after its exposure for which an encoded image is used in a step."""
    head_batch_size: Annotated[int, Between(1, 100_000)] = 256
    """Samples a step while the head learns alone."""
    gate_weight: Annotated[float, Between(0, 10_000)] = 100.0
    """Weight of the loss of gate positions that are read off the feature, in flights that hold
    them; 0 = off. The sticks of a few flights alone teach an encoder those flights' courses."""
    disturb: bool = True
    """Recolour images, light them unevenly, veil and cover them, each a quarter, while the encoder
    learns; --no-disturb where brightness or colour is what the policy is to look at."""
    pack: bool = False
    """Write a checkpoint to ship, a third of the size: the encoder in int8, the rest in float16."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.only_end and self.start_from is None:
            raise PolicyError("--only-end needs --start-from: the policy that learns the end")
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

    image_size: Annotated[int, Between(32, 1024)] = 64
    """Pixels along a side of the frames."""
    batch_size: Annotated[int, Between(2, 4096)] = 8
    """Frames a step while the autoencoder learns."""
    learning_rate: Annotated[float, Between(0, 1e30)] = 2e-3
    """Peak learning rate of AdamW."""
    window_batch_size: Annotated[int, Between(1, 4096)] = 8
    """Windows a step while the dynamics learns."""
    start_from: Path | None = None
    """World model whose autoencoder is kept as it is; the dynamics learns anew."""
    autoencoder_share: Annotated[float, Between(0.01, 0.99)] = 0.25
    """Share of the run in which the autoencoder learns, unless it is kept."""
    decision_share: Annotated[float, Between(0, 1)] = 0.3
    """Share of the windows in which the model has to find the actions."""


ENCODER_SHARE_OF_TIME, ENCODER_SHARE_OF_STEPS = 0.75, 0.45
"""Share of a policy's training in which its encoder learns."""


class TrainingStage(NamedTuple):
    """Part of a run, up to a fraction of its budget."""

    name: str
    end: float
    trains_encoder: bool


def policy_stages(settings: TrainSettings) -> tuple[TrainingStage, ...]:
    """Return the stages: encoder and head, unless only the end is learned; then the head alone."""
    if settings.only_end:
        return (TrainingStage("head", 1.0, False),)
    share = ENCODER_SHARE_OF_TIME if settings.steps is None else ENCODER_SHARE_OF_STEPS
    return TrainingStage("encoder and head", share, True), TrainingStage("head", 1.0, False)


def world_model_stages(settings: WorldModelSettings) -> tuple[TrainingStage, ...]:
    """Return the stages: autoencoder, unless an existing one is kept, then dynamics."""
    dynamics = TrainingStage("dynamics", 1.0, False)
    if settings.start_from is not None:
        return (dynamics,)
    return TrainingStage("autoencoder", settings.autoencoder_share, True), dynamics


def learning_rate_factor(progress: float) -> float:
    """Return a linear warm-up over the first twentieth, then half a cosine down to a hundredth."""
    warm_up = 0.05
    if progress < warm_up:
        return max(progress / warm_up, 0.01)
    along = min((progress - warm_up) / (1 - warm_up), 1.0)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * along))
