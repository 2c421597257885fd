"""The stages of a training run, and its learning rate.

First the encoder learns: of a policy together with its head, on images that grow from stage to
stage, because the encoders are fully convolutional and a small image costs a fraction; of a world
model alone. Then it is frozen, each image is encoded once, and the rest learns from the stored
features: some ten times the steps.
"""

import math
from dataclasses import dataclass

from policy.training.settings import TrainSettings, WorldModelSettings

_SIZES = ((3 / 7, 0.35, 0.20), (5 / 7, 0.30, 0.15), (1.0, 0.10, 0.10))
"""Image size over the full one, share of the time, share of the steps; the head has the rest."""
MIN_IMAGE_SIZE = 96
"""Below it, an image costs a CPU hardly less."""


@dataclass(frozen=True)
class TrainingStage:
    """A part of a run, between two fractions of its budget."""

    name: str
    start: float
    end: float
    image_size: int
    """Pixels along a side."""
    trains_encoder: bool
    is_scored: bool
    """Its weights may be exported."""


def policy_stages(settings: TrainSettings) -> tuple[TrainingStage, ...]:
    """Stages of a policy's training, in order; they fill the budget."""
    full, shares = settings.image_size, dict[int, float]()
    if not settings.freeze_encoder:
        for wanted, of_time, of_steps in _SIZES:
            scale = max(wanted, min(MIN_IMAGE_SIZE / full, 1.0))
            # A multiple of 32, the stride of all encoders, where it is not the full size.
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
    """Autoencoder, unless it is kept, then dynamics."""
    turn, size = settings.autoencoder_share, settings.image_size
    if settings.start_from is not None:
        return (TrainingStage("dynamics", 0.0, 1.0, size, False, True),)
    return (
        TrainingStage("autoencoder", 0.0, turn, size, True, False),
        TrainingStage("dynamics", turn, 1.0, size, False, True),
    )


def learning_rate_factor(progress: float) -> float:
    """Linear warm-up over the first twentieth, then half a cosine down to a hundredth."""
    warm_up = 0.05
    if progress < warm_up:
        return max(progress / warm_up, 0.01)
    along = min((progress - warm_up) / (1 - warm_up), 1.0)
    return 0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * along))
