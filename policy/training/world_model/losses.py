"""What is optimised of a world model, the scales that it is told, and how well it foretells."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from policy.contract import STATE_DIM, VELOCITY
from policy.data.interpolation import Indices
from policy.data.samples import STICK_SIGNS, mirror_signs
from policy.data.windows import Windows
from policy.training.batches import PooledStore
from policy.training.parallel import StepLoss
from policy.training.report import WorldValidation
from policy.training.world_model.batches import FrameBatch, WindowBatch
from policy.world_model.autoencoder import to_unit
from policy.world_model.dynamics import Future
from policy.world_model.frame_warp import Poses, View
from policy.world_model.model import WorldModel
from policy.world_model.relative_state import MOTION_SCALE, motion_since

SQUARED_WEIGHT = 5.0
"""Of the squared error beside the absolute one, which alone is content with a picture without the
small things in it."""
GRADIENT_WEIGHT = 1.0
"""Of the error of differences between neighbouring pixels: a gate is a few pixels of edge."""
KL_WEIGHT = 1e-4
"""Per latent: keeps them in bounds. More of it gives each the same spread, and so the ground's
texture, which nobody can foretell, as much of a say as the gates."""
UNSTEADY_WEIGHT = 0.03
"""Of the change of the latents from frame to frame, over their spread. Without it copying the last
latent is off by half of their variance one frame on; pixels are hardly the worse for it."""
LOOKED_AT_WEIGHT = 10.0
"""Of the squared error of decoded pixels, full scale 2: not all errors of latents can be seen."""
MOTION_WEIGHT, ACTION_WEIGHT = 0.5, 0.5
FORESEEN_WEIGHT = 0.5
"""Of the squared error of the motion that is foreseen before anything is denoised."""
CARRIED_WEIGHT = 1.0
"""Of the absolute error of pixels of frames moved by the true motion: what nearness learns from."""
MIN_MOTION_STD = 0.05
"""Of ``MOTION_SCALE``: what hardly changes does not count more than this makes it."""
MIN_STICK_STD = 0.1
SCALE_SAMPLES = 4096
"""Frames and windows from which scales are taken."""
CHANGE_SAMPLES = 1024
"""Windows of them whose latents are read."""
MIN_CHANGE_STD = 0.05
"""Of unit scale, as ``MIN_MOTION_STD``."""
VALIDATION_STEPS = 4
"""Denoising steps of imagined futures."""


def autoencoder_loss(model: WorldModel, batch: FrameBatch) -> StepLoss:
    """Errors of pixels and of their differences, unsteadiness, and a little KL."""
    images = to_unit(batch.images.flatten(0, 1))
    mean, log_variance = model.autoencoder.posterior(images)
    latents = mean + (0.5 * log_variance).exp() * batch.noise.flatten(0, 1)
    made = model.autoencoder.reconstruct(latents).float()
    pixels, edges = reconstruction_errors(made, images)
    mean, log_variance = mean.float(), log_variance.float()
    kl = 0.5 * (mean.square() + log_variance.exp() - 1 - log_variance).mean()
    change = mean.reshape(-1, 2, *mean.shape[1:]).diff(dim=1).square().mean()
    unsteady = change / mean.var(dim=(0, 2, 3)).mean().clamp_min(1e-3)
    loss = pixels + GRADIENT_WEIGHT * edges + KL_WEIGHT * kl + UNSTEADY_WEIGHT * unsteady
    told = {"loss": loss, "pixels": pixels, "edges": edges, "kl": kl, "unsteady": unsteady}
    return StepLoss(total=loss, told=told)


def reconstruction_errors(made: Tensor, images: Tensor) -> tuple[Tensor, Tensor]:
    """Of [B, 3, H, W] in [-1, 1]: L2 and L1 [], and L1 of the differences between neighbours."""
    error = made - images
    edges = error.diff(dim=2).abs().mean() + error.diff(dim=3).abs().mean()
    return SQUARED_WEIGHT * error.square().mean() + error.abs().mean(), edges


def dynamics_loss(model: WorldModel, batch: WindowBatch) -> StepLoss:
    """Squared errors of what was denoised, and of some of its frames as pixels.

    Those of latents are over the change since the last frame: 1 is what copying it would give at
    every step, so that the first steps, from which a rollout goes on, count as much as the last.
    """
    config = model.config
    context = config.context_frames
    latents = _normalised_latents(model, batch.latents)
    past_states, states = batch.states[:, :context], batch.states[:, context:]
    with torch.autocast(states.device.type, enabled=False):  # angles need all their digits
        motion = motion_since(past_states[:, -1:], states)
    clean = Future(
        latents=latents[:, context:],
        motion=model.normalise_motion(motion),
        actions=model.normalise_actions(batch.actions),
    )
    past_latents = latents[:, :context] + batch.context_noise
    view = model.view(past_latents[:, -1], past_states[:, -1])
    past = model.foresee(view, past_latents, past_states, clean.actions, batch.knows_actions)
    add, timestep = config.schedule.add_noise, batch.timestep
    knows = batch.knows_actions.view(-1, 1, 1)
    noisy = Future(
        latents=add(clean.latents, batch.latent_noise, timestep),
        motion=add(clean.motion, batch.motion_noise, timestep),
        actions=torch.where(knows, clean.actions, add(clean.actions, batch.action_noise, timestep)),
    )
    made = model.denoise(noisy, timestep, past)
    picture = ((made.latents.float() - clean.latents) / model.change_std).square().mean()
    true = _seen(model, clean.latents, batch.looked_at).detach()
    pixels = (_seen(model, made.latents, batch.looked_at) - true).square().mean()
    poses = model.poses(past_states[:, -1], motion).of(batch.looked_at)
    carried = _carried_error(model, view, poses, true)
    vehicle = (made.motion.float() - clean.motion).square().mean()
    foreseen = (past.foreseen - clean.motion).square().mean()
    # Known sticks are told as they are given: no error.
    sticks = (made.actions.float() - clean.actions).square().mean()
    loss = (
        picture
        + LOOKED_AT_WEIGHT * pixels
        + CARRIED_WEIGHT * carried
        + MOTION_WEIGHT * vehicle
        + FORESEEN_WEIGHT * foreseen
        + ACTION_WEIGHT * sticks
    )
    told = {
        "loss": loss,
        "latents": picture,
        "pixels": pixels,
        "carried": carried,
        "motion": vehicle,
        "foreseen": foreseen,
        "sticks": sticks,
    }
    return StepLoss(total=loss, told=told)


def _seen(model: WorldModel, latents: Tensor, looked_at: Tensor) -> Tensor:
    """Frames [B, n, 3, H, W] with numbers [B, n] of futures [B, T, C, h, w]; full scale 2."""
    coder, window = model.autoencoder, torch.arange(len(latents), device=latents.device)[:, None]
    chosen = latents[window, looked_at]
    seen = coder.reconstruct(coder.denormalise(chosen.flatten(0, 1)))
    return seen.float().reshape(*chosen.shape[:2], *seen.shape[1:])


def _carried_error(model: WorldModel, view: View, poses: Poses, true: Tensor) -> Tensor:
    """Absolute error [] of the newest frame moved to other poses, where it was in view."""
    made, in_view = model.moved(view, poses)
    return ((made - true).abs().mean(dim=2) * in_view).mean()


def _normalised_latents(model: WorldModel, latents: Tensor) -> Tensor:
    flat = model.autoencoder.normalise(latents.flatten(0, 1))
    return flat.reshape(latents.shape)


@torch.no_grad()
def set_scales(model: WorldModel, windows: Windows, latents: PooledStore, *, mirrors: bool) -> None:
    """Tell the model the mean and spread of latents, motions and sticks of the flights."""
    config, coder = model.config, model.autoencoder
    total = len(latents.frames)
    frames = latents.frames[np.linspace(0, total - 1, min(SCALE_SAMPLES, total)).astype(np.int64)]
    rows = torch.from_numpy(latents.read(frames, np.zeros(len(frames), bool)))
    values = rows.reshape(len(frames), config.latent_channels, -1).transpose(0, 1).flatten(1)
    coder.latent_mean.copy_(values.mean(dim=1))
    coder.latent_std.copy_(values.std(dim=1).clamp_min(1e-3))
    chosen = windows.spread(SCALE_SAMPLES)
    samples = chosen.samples(np.arange(len(chosen)))
    model.change_std.copy_(_change_std(model, chosen.spread(CHANGE_SAMPLES).frames, latents))
    states, actions = torch.from_numpy(samples.states), torch.from_numpy(samples.actions)
    if mirrors:
        signs = torch.from_numpy(mirror_signs(STATE_DIM))
        states = torch.cat([states, states * signs])
        actions = torch.cat([actions, actions * torch.from_numpy(STICK_SIGNS)])
    now = states[:, config.context_frames - 1 : config.context_frames]
    motion = motion_since(now, states[:, config.context_frames :])
    least = MIN_MOTION_STD * torch.tensor(MOTION_SCALE)
    model.motion_mean.copy_(motion.mean(dim=0))
    model.motion_std.copy_(torch.maximum(motion.std(dim=0, correction=0), least))
    model.action_mean.copy_(actions.mean(dim=(0, 1)))
    model.action_std.copy_(actions.std(dim=(0, 1), correction=0).clamp_min(MIN_STICK_STD))


def _change_std(model: WorldModel, frames: Indices, latents: PooledStore) -> Tensor:
    """Spread [T, C, 1, 1] of the change of normalised latents in windows of frames [W, K + T]."""
    config = model.config
    rows = torch.from_numpy(latents.read(frames.ravel(), np.zeros(frames.size, bool)))
    side = config.latent_side
    raw = rows.reshape(*frames.shape, config.latent_channels, side, side)
    windows = _normalised_latents(model, raw)
    now = windows[:, config.context_frames - 1 : config.context_frames]
    change = windows[:, config.context_frames :] - now
    std = change.square().mean(dim=(0, 3, 4), keepdim=True).sqrt()
    return std[0].clamp_min(MIN_CHANGE_STD)


@torch.no_grad()
def validate_autoencoder(model: WorldModel, images: Tensor) -> WorldValidation:
    """How well frames [N, H, W, 3] survive being coded; the loss is that of the pixels."""
    made = model.decode(model.encode(images))
    pixels, edges = reconstruction_errors(to_unit(made), to_unit(images))
    return WorldValidation(
        loss=float(pixels + GRADIENT_WEIGHT * edges),
        reconstruction_psnr_db=float(psnr_db(made, images).mean()),
    )


@torch.no_grad()
def validate_world_model(
    model: WorldModel, batches: Sequence[WindowBatch], frames: Tensor
) -> WorldValidation:
    """Losses over all ``batches``, and how well the first of them is imagined.

    Args:
        model: in eval mode.
        batches: of held-out windows.
        frames: [B, K + T, H, W, 3] uint8, those of the first batch as they were seen.
    """
    losses = [float(dynamics_loss(model, batch).told["loss"]) for batch in batches]
    context, first = model.config.context_frames, batches[0]
    latents, states = _normalised_latents(model, first.latents), first.states
    imagined = model.sample(
        latents[:, :context],
        states[:, :context],
        first.actions,
        ddim_steps=min(VALIDATION_STEPS, model.config.schedule.num_train_timesteps),
        noise_seed=0,
        sim_mode=True,
        decode_video=True,
    )
    if imagined.video is None:
        raise RuntimeError("sample made no video")
    future, last = frames[:, context:], frames[:, context - 1 : context]
    coded = model.decode(latents[:, context])
    end, now = states[:, -1, VELOCITY], states[:, context - 1, VELOCITY]
    return WorldValidation(
        loss=sum(losses) / len(losses),
        reconstruction_psnr_db=float(psnr_db(coded, frames[:, context]).mean()),
        psnr_db=float(psnr_db(imagined.video, future).mean()),
        copy_psnr_db=float(psnr_db(last.expand_as(future), future).mean()),
        velocity_error_mps=float((imagined.states[:, -1, VELOCITY] - end).norm(dim=-1).mean()),
        held_velocity_error_mps=float((now - end).norm(dim=-1).mean()),
    )


def psnr_db(made: Tensor, true: Tensor) -> Tensor:
    """Peak signal to noise ratio [...] of frames [..., H, W, 3] uint8; 99 where they are equal."""
    squared = (made.float() - true.float()).square().mean(dim=(-3, -2, -1))
    return (10 * torch.log10(255.0**2 / squared)).clamp_max(99.0)
