"""Training of a world model from flights: the autoencoder, then the dynamics on stored latents."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

from policy.checkpoints.networks import load_world_model, save_world_model
from policy.data.flight_data import FlightData
from policy.data.windows import Windows, find_windows
from policy.errors import PolicyError
from policy.nets.world_model.autoencoder import to_unit
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.model import WorldModel
from policy.training.batches import StepLoss
from policy.training.report import Hooks, TrainResult, WorldModelValidation
from policy.training.run import TrainingRun, computing_in, work_folder
from policy.training.settings import WorldModelSettings, world_model_stages
from policy.training.world_model_losses import (
    FrameBatch,
    WindowBatch,
    WindowBatches,
    autoencoder_loss,
    dynamics_loss,
    frame_batch,
    set_scales,
    validate_world_model,
)

VALIDATION_WINDOWS = 128
IMAGINED_WINDOWS = 16
"""Number of held-out windows to imagine frame by frame."""


def train_world_model(
    flights: Sequence[FlightData],
    config: WorldModelConfig,
    settings: WorldModelSettings,
    hooks: Hooks,
) -> TrainResult:
    """Train, and write the weights that are best on held-out flights to ``settings.out``."""
    with work_folder(settings) as folder:
        return _WorldModelRun(flights, config, settings, hooks, folder).finish()


class _WorldModelRun(TrainingRun[WorldModel, FrameBatch | WindowBatch]):
    encoder_learns_alone = True

    def __init__(
        self,
        flights: Sequence[FlightData],
        config: WorldModelConfig,
        settings: WorldModelSettings,
        hooks: Hooks,
        folder: Path,
    ) -> None:
        self.settings: WorldModelSettings = settings
        self._config = config
        model = _starting_model(config, settings)
        super().__init__(flights, model, world_model_stages(settings), hooks, folder)
        windows = self._windows_of(self.flights)
        self._windows = windows.among(self.frames_of(self.kept))
        self._held = windows.among(self.frames_of(self.held)).spread(VALIDATION_WINDOWS)
        self._held_batches: list[WindowBatch] = []

    def check(self, flight: FlightData) -> None:
        self._windows_of([flight])

    def _windows_of(self, flights: Sequence[FlightData]) -> Windows:
        return find_windows(
            flights,
            context_frames=self._config.context_frames,
            frames=self._config.frames,
            frame_dt_s=self._config.frame_dt_s,
        )

    def encoder(self, trainee: WorldModel) -> nn.Module:
        return trainee.autoencoder

    def features_of(self, images: Tensor) -> Tensor:
        return self.trainee.autoencoder.posterior(to_unit(images))[0].flatten(1)

    def encode(self) -> None:
        frames = np.union1d(self._held.frames, self._windows.frames)
        latents = self.features = self.encode_frames(frames)
        set_scales(self.trainee, self._windows, latents, mirrors=self.settings.mirror)
        if len(self._held):
            batches = WindowBatches(self._held, latents, self._config, self.settings)
            moved = [batch.to(self.device) for batch in batches.validation(IMAGINED_WINDOWS)]
            self._held_batches = moved

    def batch_maker(self) -> Callable[[int], FrameBatch | WindowBatch]:
        config, settings, windows = self._config, self.settings, self._windows
        if self.features is not None:
            return WindowBatches(windows, self.features, config, settings).batch
        return lambda step: frame_batch(self.images, windows, config, settings, step)

    def losses(self, batch: FrameBatch | WindowBatch) -> StepLoss:
        if isinstance(batch, FrameBatch):
            return autoencoder_loss(self.trainee, batch)
        return dynamics_loss(self.trainee, batch)

    def validate(self) -> WorldModelValidation | None:
        if not self._held_batches:
            return None
        frames = self._held.frames[:: len(self._held_batches)]
        images = self.images_of(frames)
        with computing_in(self.device, self.bf16):
            return validate_world_model(self.average, self._held_batches, images)

    def export(self) -> None:
        counts = {"flights": len(self.kept), "images": len(self.frames_of(self.kept))}
        card = self.card(**counts, windows=len(self._windows))
        save_world_model(self.settings.out, self.average, training=card)


def _starting_model(config: WorldModelConfig, settings: WorldModelSettings) -> WorldModel:
    """Return seeded weights, except a kept autoencoder's; keeps torch's random state."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(settings.seed)
        model = WorldModel(config)
    if (path := settings.start_from) is not None:
        old = load_world_model(path)
        for name in ("image_size", "latent_channels", "autoencoder_widths"):
            theirs, ours = (getattr(each, name) for each in (old.config, config))
            if theirs != ours:
                raise PolicyError(
                    f"--start-from {path}: its autoencoder has {name} {theirs}, this model {ours}: "
                    "ask for the same, or leave out --start-from"
                )
        model.autoencoder.load_state_dict(old.autoencoder.state_dict())
    return model.to(settings.device)
