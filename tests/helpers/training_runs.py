"""The smallest world model, hooks of a training run on a made-up clock, and written weights."""

import json
from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import Any

from safetensors import safe_open

from policy.checkpoints.networks import TRAINING_KEY
from policy.contract import Contract
from policy.nets.world_model.config import WorldModelConfig
from policy.training.report import Hooks, TrainingProgress

SMALL_WORLD = WorldModelConfig(
    image_size=32,
    latent_channels=4,
    frames=4,
    autoencoder_widths=(8, 8, 16),
    dynamics_width=32,
    dynamics_depth=2,
    contract=Contract(image_height=32, image_width=32),
)


def make_hooks(
    report: Callable[[TrainingProgress], None] = lambda _: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> Hooks:
    """Make hooks with a clock that advances by a tenth of a second at every reading."""
    ticking = count()
    return Hooks(now_s=lambda: next(ticking) * 0.1, report=report, should_stop=should_stop)


def card_of(path: Path) -> dict[str, Any]:
    """Return what a checkpoint says of its training."""
    with safe_open(path, framework="pt") as file:
        card: dict[str, Any] = json.loads(file.metadata()[TRAINING_KEY])
    return card


def weights_of(path: Path) -> dict[str, bytes]:
    """Return every tensor of a checkpoint, as stored in the file."""
    with safe_open(path, framework="pt") as file:
        return {name: file.get_tensor(name).numpy().tobytes() for name in file.keys()}  # noqa: SIM118
