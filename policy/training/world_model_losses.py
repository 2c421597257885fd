"""Batches, losses, scales and validation of a world model's training.

Frames are for the autoencoder, windows of latents for the dynamics; a batch is a pure function of
the seed and the step.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from policy.contract import ACTION_DIM, STATE_DIM, VELOCITY, FloatArray
from policy.data.flight_data import ImageArray
from policy.data.interpolation import Indices
from policy.data.samples import STICK_SIGNS, mirrored, state_signs
from policy.data.windows import Windows
from policy.nets.world_model.autoencoder import to_unit
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.dynamics import Future
from policy.nets.world_model.model import WorldModel
from policy.nets.world_model.motion import MOTION_DIM, MOTION_SCALE, motion_since
from policy.training.batches import VALIDATION_KEY, FeatureStore, StepLoss, TensorBatch, next_of
from policy.training.report import WorldModelValidation
from policy.training.settings import WorldModelSettings

CONTEXT_NOISE = 0.2
"""Largest sigma of the noise on past latents, relative to their unit scale: in a rollout the past
is itself imagined, and a network that has only seen true pasts drifts off."""
DECODED = 2
"""Frames of a window to decode in a step of the dynamics; decoding all would double its time."""
SQUARED_WEIGHT = 5.0
"""Weight of the squared pixel error; the absolute error alone ignores small objects."""
EDGE_WEIGHT = 1.0
"""Weight of the error of differences between neighbours: a gate is a few pixels of edge."""
KL_WEIGHT = 1e-4
"""Weight of the KL divergence per latent, which keeps the latents bounded. A larger weight gives
all of them equal spread, so that the ground's unpredictable texture counts as much as the gates."""
UNSTEADY_WEIGHT = 0.03
"""Weight of the latents' change from frame to frame, relative to their spread. Without it, copying
the last latent is off by half of their variance after one frame; it hardly costs pixel accuracy."""
DECODED_WEIGHT = 10.0
"""Weight of the squared error of decoded pixels, full scale 2: some latent errors are invisible."""
MOTION_WEIGHT, ACTION_WEIGHT = 0.5, 0.5
MOTION_PREDICTION_WEIGHT = 0.5
"""Weight of the squared error of the motion that is predicted before denoising."""
WARP_WEIGHT = 1.0
"""Weight of the absolute pixel error of frames warped by the true motion: the only loss that
teaches the inverse depth."""
MIN_MOTION_STD = 0.05
"""Lower bound of a motion's standard deviation, relative to ``MOTION_SCALE``: bounds the weight of
motions that hardly change."""
MIN_STICK_STD = 0.1
SCALE_SAMPLES = 4096
"""Number of frames and windows to compute the scales from."""
CHANGE_SAMPLES = 1024
"""Number of these windows whose latents are read."""
MIN_CHANGE_STD = 0.05
"""Minimum spread of a change, relative to unit scale."""
VALIDATION_STEPS = 4
"""Denoising steps of imagined futures."""


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
    every: ImageArray,
    windows: Windows,
    config: WorldModelConfig,
    settings: WorldModelSettings,
    step: int,
) -> FrameBatch:
    """Return two neighbours of each of the ``windows`` due in a step of the autoencoder, from the
    images [N, H, W, 3] of all flights."""
    count = settings.batch_size // 2
    random = np.random.default_rng([settings.seed, step])
    rows = next_of(np.arange(len(windows)), step, count, settings.seed)
    first = random.integers(0, windows.frames.shape[1] - 1, count)
    pairs = np.stack([windows.frames[rows, first], windows.frames[rows, first + 1]], axis=1)
    images = every[pairs]
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
        is_mirrored = (random.random(count) < 0.5) & self._settings.mirror
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
        config, windows = self._config, self._windows.at(rows)
        count, length = windows.frames.shape
        states = windows.states[windows.frames]
        shape = config.latent_shape
        flat = self._latents.read(windows.frames.ravel(), np.repeat(is_mirrored, length))

        def drawn(*size: int) -> FloatArray:
            return random.standard_normal((count, *size), dtype=np.float32)

        arrays = {
            "latents": flat.reshape(count, length, *shape),
            "states": mirrored(states, state_signs(STATE_DIM), is_mirrored),
            "actions": mirrored(windows.actions, STICK_SIGNS, is_mirrored),
            "context_noise": sigma * drawn(config.context_frames, *shape),
            "latent_noise": drawn(config.frames, *shape),
            "motion_noise": drawn(config.frames, MOTION_DIM),
            "action_noise": drawn(config.frames, ACTION_DIM),
            "timestep": random.integers(0, config.schedule.num_train_timesteps, count),
            "knows_actions": knows_actions,
            "decoded": random.integers(0, config.frames, (count, DECODED)),
        }
        return WindowBatch(**{name: torch.from_numpy(array) for name, array in arrays.items()})


def autoencoder_loss(model: WorldModel, batch: FrameBatch) -> StepLoss:
    """Return the errors of pixels and of their differences, unsteadiness, and a little KL."""
    images = to_unit(batch.images.flatten(0, 1))
    mean, log_variance = model.autoencoder.posterior(images)
    latents = mean + (0.5 * log_variance).exp() * batch.noise.flatten(0, 1)
    made = model.autoencoder.reconstruct(latents).float()
    error = made - images
    pixels = SQUARED_WEIGHT * error.square().mean() + error.abs().mean()
    edges = error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
    mean, log_variance = mean.float(), log_variance.float()
    kl = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).mean()
    change = mean.reshape(-1, 2, *mean.shape[1:]).diff(dim=1).square().mean()
    unsteady = change / mean.var(dim=(0, 2, 3)).mean().clamp_min(1e-3)
    loss = pixels + EDGE_WEIGHT * edges + KL_WEIGHT * kl + UNSTEADY_WEIGHT * unsteady
    metrics = {"loss": loss, "pixels": pixels, "edges": edges, "kl": kl, "unsteady": unsteady}
    return StepLoss(total=loss, metrics=metrics)


def dynamics_loss(model: WorldModel, batch: WindowBatch) -> StepLoss:
    """Return squared errors of the denoised values, and of some of their frames as pixels.

    Latent errors are relative to the change since the last frame: copying it would give 1 at every
    step, so the first steps, from which a rollout continues, count as much as the last.
    """
    config = model.config
    context = config.context_frames
    latents = _normalised(model, batch.latents)
    past_states, states = batch.states[:, :context], batch.states[:, context:]
    with torch.autocast(states.device.type, enabled=False):  # angles need full precision
        motion = motion_since(past_states[:, -1:], states)
    clean = Future(
        latents=latents[:, context:],
        motion=model.normalise_motion(motion),
        actions=model.normalise_actions(batch.actions),
    )
    past_latents = latents[:, :context] + batch.context_noise
    source = model.source_frame(past_latents[:, -1], past_states[:, -1])
    known = model.predict_motion(
        source, past_latents, past_states, clean.actions, batch.knows_actions
    )
    made = model.denoise(_noisy(model, clean, batch), batch.timestep, known)
    true = _decoded(model, clean.latents, batch.decoded).detach()
    poses = model.poses(past_states[:, -1], motion).at(batch.decoded)
    warped, in_view = model.warp(source, poses)
    errors = {
        "latents": ((made.latents.float() - clean.latents) / model.change_std).square().mean(),
        "pixels": (_decoded(model, made.latents, batch.decoded) - true).square().mean(),
        "warp": ((warped - true).abs().mean(dim=2) * in_view).mean(),
        "motion": (made.motion.float() - clean.motion).square().mean(),
        "motion_prediction": (known.predicted_motion - clean.motion).square().mean(),
        # Given sticks are returned unchanged: no error.
        "sticks": (made.actions.float() - clean.actions).square().mean(),
    }
    loss = (
        errors["latents"]
        + DECODED_WEIGHT * errors["pixels"]
        + WARP_WEIGHT * errors["warp"]
        + MOTION_WEIGHT * errors["motion"]
        + MOTION_PREDICTION_WEIGHT * errors["motion_prediction"]
        + ACTION_WEIGHT * errors["sticks"]
    )
    return StepLoss(total=loss, metrics={"loss": loss, **errors})


def _noisy(model: WorldModel, clean: Future, batch: WindowBatch) -> Future:
    add, timestep = model.config.schedule.add_noise, batch.timestep
    knows, actions = batch.knows_actions.view(-1, 1, 1), clean.actions
    return Future(
        latents=add(clean.latents, batch.latent_noise, timestep),
        motion=add(clean.motion, batch.motion_noise, timestep),
        actions=torch.where(knows, actions, add(actions, batch.action_noise, timestep)),
    )


def _decoded(model: WorldModel, latents: Tensor, chosen: Tensor) -> Tensor:
    """Decode frames [B, n, 3, H, W], indices [B, n], of futures [B, T, C, h, w]; full scale 2."""
    coder, window = model.autoencoder, torch.arange(len(latents), device=latents.device)[:, None]
    some = latents[window, chosen]
    images = coder.reconstruct(coder.denormalise(some.flatten(0, 1)))
    return images.float().reshape(*some.shape[:2], *images.shape[1:])


def _normalised(model: WorldModel, latents: Tensor) -> Tensor:
    return model.autoencoder.normalise(latents.flatten(0, 1)).reshape(latents.shape)


@torch.no_grad()
def set_scales(
    model: WorldModel, windows: Windows, latents: FeatureStore, *, mirrors: bool
) -> None:
    """Store the mean and spread of latents, motions and sticks of the flights in the model."""
    config, coder = model.config, model.autoencoder
    total = len(latents.frames)
    frames = latents.frames[np.linspace(0, total - 1, min(SCALE_SAMPLES, total)).astype(np.int64)]
    rows = torch.from_numpy(latents.read(frames, np.zeros(len(frames), bool)))
    values = rows.reshape(len(frames), config.latent_channels, -1).transpose(0, 1).flatten(1)
    coder.latent_mean.copy_(values.mean(dim=1))
    coder.latent_std.copy_(values.std(dim=1).clamp_min(1e-3))
    chosen = windows.spread(SCALE_SAMPLES)
    model.change_std.copy_(_change_std(model, chosen.spread(CHANGE_SAMPLES), latents))
    states = torch.from_numpy(chosen.states[chosen.frames])
    actions = torch.from_numpy(chosen.actions)
    if mirrors:
        states = torch.cat([states, states * torch.from_numpy(state_signs(STATE_DIM))])
        actions = torch.cat([actions, actions * torch.from_numpy(STICK_SIGNS)])
    now = states[:, config.context_frames - 1 : config.context_frames]
    motion = motion_since(now, states[:, config.context_frames :])
    least = MIN_MOTION_STD * torch.tensor(MOTION_SCALE)
    model.motion_mean.copy_(motion.mean(dim=0))
    model.motion_std.copy_(torch.maximum(motion.std(dim=0, correction=0), least))
    model.action_mean.copy_(actions.mean(dim=(0, 1)))
    model.action_std.copy_(actions.std(dim=(0, 1), correction=0).clamp_min(MIN_STICK_STD))


def _change_std(model: WorldModel, windows: Windows, latents: FeatureStore) -> Tensor:
    """Return the spread [T, C, 1, 1] of the change of normalised latents in some windows."""
    context, frames = model.config.context_frames, windows.frames
    rows = torch.from_numpy(latents.read(frames.ravel(), np.zeros(frames.size, bool)))
    rows = rows.to(model.change_std.device).reshape(*frames.shape, *model.config.latent_shape)
    normal = _normalised(model, rows)
    change = normal[:, context:] - normal[:, context - 1 : context]
    return change.square().mean(dim=(0, 3, 4))[..., None, None].sqrt().clamp_min(MIN_CHANGE_STD)


@torch.no_grad()
def validate_world_model(
    model: WorldModel, batches: Sequence[WindowBatch], frames: Tensor
) -> WorldModelValidation:
    """Return the losses of all held-out ``batches``, and the errors of imagining the first batch.

    ``frames`` [B, K + T, H, W, 3] uint8 are the true frames of that batch.
    """
    losses = [float(dynamics_loss(model, batch).metrics["loss"]) for batch in batches]
    context, first = model.config.context_frames, batches[0]
    latents, states = _normalised(model, first.latents), first.states
    imagined = model.sample(
        latents[:, :context],
        states[:, :context],
        first.actions,
        ddim_steps=min(VALIDATION_STEPS, model.config.schedule.num_train_timesteps),
        noise_seed=0,
    )
    video = model.decode(imagined.latents.flatten(0, 1))
    future, last = frames[:, context:], frames[:, context - 1 : context]
    coded = model.decode(latents[:, context])
    end, now = states[:, -1, VELOCITY], states[:, context - 1, VELOCITY]
    return WorldModelValidation(
        loss=sum(losses) / len(losses),
        reconstruction_psnr_db=float(psnr_db(coded, frames[:, context]).mean()),
        psnr_db=float(psnr_db(video.reshape(future.shape), future).mean()),
        copy_psnr_db=float(psnr_db(last.expand_as(future), future).mean()),
        velocity_error_mps=float((imagined.states[:, -1, VELOCITY] - end).norm(dim=-1).mean()),
        held_velocity_error_mps=float((now - end).norm(dim=-1).mean()),
    )


def psnr_db(made: Tensor, true: Tensor) -> Tensor:
    """Return the peak signal-to-noise ratio [...] of uint8 [..., H, W, 3]; 99 if equal."""
    squared = (made.float() - true.float()).square().mean(dim=(-3, -2, -1))
    return (10 * torch.log10(255.0**2 / squared)).clamp_max(99.0)
