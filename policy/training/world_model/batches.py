"""Batches for a world model: frames for its autoencoder, windows of latents for its dynamics.

A pure function of the seed and the step.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policy.contract import FloatArray
from policy.data.frames import FrameStore
from policy.data.interpolation import Indices
from policy.data.samples import STICK_SIGNS, mirrored, state_signs
from policy.data.windows import Windows
from policy.training.batches import VALIDATION_KEY, FeatureStore, next_of
from policy.training.parallel import TensorBatch
from policy.training.settings import WorldModelSettings
from policy.world_model.config import WorldModelConfig
from policy.world_model.relative_state import MOTION_DIM

CONTEXT_NOISE = 0.2
"""Largest sigma of the noise on past latents, relative to their unit scale: in a rollout the past
is itself imagined, and a network that has only seen true pasts drifts off."""
DECODED = 2
"""Frames of a window to decode in a step of the dynamics; decoding all would double its time."""


@dataclass(frozen=True, kw_only=True)
class FrameBatch(TensorBatch):
    """Pairs of frames, and the noise of a step."""

    images: Tensor
    """[B, 2, H, W, 3] uint8: neighbours in a window."""
    noise: Tensor
    """[B, 2, C, h, w] of unit scale, for the latents."""


@dataclass(frozen=True, kw_only=True)
class WindowBatch(TensorBatch):
    """Windows of K + T frames, and all random values of a step.

    Each noise [B, T, ...] has the shape of its target.
    """

    latents: Tensor
    """[B, K + T, C, h, w], not normalised."""
    states: Tensor
    """[B, K + T, 13]"""
    actions: Tensor
    """[B, T, 4]"""
    context_noise: Tensor
    """[B, K, C, h, w], at the unit scale of normalised latents."""
    latent_noise: Tensor
    motion_noise: Tensor
    action_noise: Tensor
    timestep: Tensor
    """[B] int64"""
    knows_actions: Tensor
    """[B] bool"""
    decoded: Tensor
    """[B, DECODED] int64: future frames that are also compared as pixels."""


def frame_batch(
    store: FrameStore,
    windows: Windows,
    config: WorldModelConfig,
    settings: WorldModelSettings,
    step: int,
) -> FrameBatch:
    """Return two neighbours of each of the ``windows`` due in a step of the autoencoder."""
    count = settings.batch_size // 2
    random = np.random.default_rng([settings.seed, step])
    rows = next_of(np.arange(len(windows)), step, count, settings.seed)
    first = random.integers(0, windows.frames.shape[1] - 1, count)
    pairs = np.stack([windows.frames[rows, first], windows.frames[rows, first + 1]], axis=1)
    images = store.read(pairs.ravel(), config.image_size)
    images = images.reshape(count, 2, *images.shape[1:])
    is_mirrored = (random.random(count) < 0.5) & settings.mirror
    images[is_mirrored] = images[is_mirrored, :, :, ::-1]
    noise = random.standard_normal((count, 2, *config.latent_shape), dtype=np.float32)
    return FrameBatch(images=torch.from_numpy(images), noise=torch.from_numpy(noise))


class WindowBatches:
    """Creates batches of the windows of one set of flights."""

    def __init__(
        self,
        windows: Windows,
        latents: FeatureStore,
        config: WorldModelConfig,
        settings: WorldModelSettings,
    ) -> None:
        self._windows, self._latents = windows, latents
        self._config, self._settings, self._seed = config, settings, settings.seed

    def batch(self, step: int) -> WindowBatch:
        """Return the windows of a step of the dynamics."""
        count = self._settings.window_batch_size
        random = np.random.default_rng([self._seed, step])
        rows = next_of(np.arange(len(self._windows)), step, count, self._seed)
        is_mirrored = (
            (random.random(count) < 0.5) & self._settings.mirror & self._latents.has_mirrored
        )
        sigma = random.uniform(0.0, CONTEXT_NOISE, (count, 1, 1, 1, 1)).astype(np.float32)
        knows_actions = random.random(count) >= self._settings.decision_share
        return self._make(random, rows, is_mirrored, sigma, knows_actions)

    def validation(self, count: int) -> list[WindowBatch]:
        """Return all windows in batches of ``count``, equal at each call, in alternating roles.

        Each batch is spread over all flights.
        """
        total = len(self._windows)
        parts = max(1, total // count)
        batches = []
        for start in range(parts):
            random = np.random.default_rng([self._seed, VALIDATION_KEY, start])
            rows = np.arange(start, total, parts)
            plain, no_noise = np.zeros(len(rows), bool), np.zeros(1, np.float32)
            knows_actions = np.arange(len(rows)) % 2 == 0
            batches.append(self._make(random, rows, plain, no_noise, knows_actions))
        return batches

    def _make(
        self,
        random: np.random.Generator,
        rows: Indices,
        is_mirrored: NDArray[np.bool_],
        sigma: FloatArray,
        knows_actions: NDArray[np.bool_],
    ) -> WindowBatch:
        config, samples = self._config, self._windows.samples(rows)
        count, length = samples.frames.shape
        shape = config.latent_shape
        flat = self._latents.read(samples.frames.ravel(), np.repeat(is_mirrored, length))

        def drawn(*size: int) -> FloatArray:
            return random.standard_normal((count, *size), dtype=np.float32)

        arrays = {
            "latents": flat.reshape(count, length, *shape),
            "states": mirrored(samples.states, state_signs(samples.states.shape[-1]), is_mirrored),
            "actions": mirrored(samples.actions, STICK_SIGNS, is_mirrored),
            "context_noise": sigma * drawn(config.context_frames, *shape),
            "latent_noise": drawn(config.frames, *shape),
            "motion_noise": drawn(config.frames, MOTION_DIM),
            "action_noise": drawn(config.frames, samples.actions.shape[-1]),
            "timestep": random.integers(0, config.schedule.num_train_timesteps, count),
            "knows_actions": knows_actions,
            "decoded": random.integers(0, config.frames, (count, DECODED)),
        }
        return WindowBatch(**{name: torch.from_numpy(array) for name, array in arrays.items()})
