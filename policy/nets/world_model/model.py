"""Latent world model: predicts the camera's images and the vehicle's motion.

    frames --encode--> latents --sample--> 16 latents, states and actions --decode--> frames

Two frames and states are the context. One network has two roles. In *simulation* the actions are
given, and latents and states are denoised; in *decision* the actions are denoised too.

Before denoising, the model predicts the motion and warps the newest frame by it. Parts that were in
view stay sharp, and the denoiser has to paint only the rest.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import ACTION_DIM
from policy.nets.diffusion import DdimStep
from policy.nets.world_model.autoencoder import FrameAutoencoder, to_bytes, to_unit
from policy.nets.world_model.config import FACTOR, WorldModelConfig
from policy.nets.world_model.dynamics import Conditioning, Future, LatentDynamics, MotionPredictor
from policy.nets.world_model.motion import (
    MOTION_DIM,
    MOTION_SCALE,
    FrameWarp,
    Poses,
    SourceFrame,
    context_features,
    poses_after,
    state_after,
    vertical_in_body,
)

LIMIT = 6.0
"""Estimates are clipped to this many standard deviations."""


@dataclass(frozen=True, kw_only=True)
class Imagined:
    """One imagined future of each of ``B`` flights."""

    latents: Tensor
    """[B, frames, C, h, w], as returned by ``encode``."""
    states: Tensor
    """[B, frames, 13] in SI units, in the contract's frame."""
    actions: Tensor
    """[B, frames, 4] sticks, given or decided."""


class WorldModel(nn.Module):
    """Autoencoder and dynamics; all scales are stored with the weights."""

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        self.config = config
        self.autoencoder = FrameAutoencoder(config.latent_channels, config.autoencoder_widths)
        self.autoencoder.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.dynamics = LatentDynamics(config)
        self.motion_predictor = MotionPredictor(config)
        self.frame_warp = FrameWarp(config)
        self.motion_mean = nn.Buffer(torch.zeros(config.frames, MOTION_DIM))
        self.motion_std = nn.Buffer(torch.tensor(MOTION_SCALE).repeat(config.frames, 1))
        self.action_mean = nn.Buffer(torch.zeros(ACTION_DIM))
        self.action_std = nn.Buffer(torch.full((ACTION_DIM,), 0.5))
        self.change_std = nn.Buffer(torch.ones(config.frames, config.latent_channels, 1, 1))

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Encode frames [N, H, W, 3] uint8 to latents [N, C, h, w] of about unit scale."""
        coder = self.autoencoder
        return coder.normalise(
            _one_by_one(lambda image: coder.posterior(image)[0], to_unit(images))
        )

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Decode latents [N, C, h, w] to frames [N, H, W, 3] uint8."""
        coder = self.autoencoder
        return to_bytes(_one_by_one(coder.reconstruct, coder.denormalise(latents)))

    @torch.no_grad()
    def sample(
        self,
        latents: Tensor,
        states: Tensor,
        actions: Tensor | None,
        *,
        ddim_steps: int,
        noise_seed: int,
    ) -> Imagined:
        """Imagine one future: simulate given actions, or decide on them.

        Args:
            latents: [B, context_frames, C, h, w] of the last frames, oldest first.
            states: [B, context_frames, 13] at their exposures, SI units, the contract's frame.
            actions: [B, frames, 4] to simulate, None to decide.
            ddim_steps: network calls.
            noise_seed: seed of the initial noise, equal on every device.
        """
        steps = self.config.schedule.ddim_steps(ddim_steps)
        batch, device = len(latents), latents.device
        noisy = self._initial_noise(batch, noise_seed, device)
        if actions is not None:
            noisy = replace(noisy, actions=self.normalise_actions(actions))
        source = self.source_frame(latents[:, -1], states[:, -1])
        knows_actions = torch.full((batch,), actions is not None, device=device)
        known = self.predict_motion(source, latents, states, noisy.actions, knows_actions)
        for step in steps:
            noisy = self._ddim_update(step, noisy, known)
        motion = noisy.motion * self.motion_std + self.motion_mean
        decided = (noisy.actions * self.action_std + self.action_mean).clamp(-1.0, 1.0)
        return Imagined(
            latents=noisy.latents,
            states=state_after(states[:, -1:], motion),
            actions=decided if actions is None else actions,
        )

    def source_frame(self, latents: Tensor, state: Tensor) -> SourceFrame:
        """Return the newest frame [B, C, h, w], seen from state [B, 13], ready to be warped."""
        coder = self.autoencoder
        with torch.no_grad():
            pixels = coder.reconstruct(_channels_last(coder.denormalise(latents)))
        with torch.autocast(latents.device.type, enabled=False):
            vertical = vertical_in_body(state)
            return self.frame_warp.source(pixels.float().clamp(-1.0, 1.0), latents, vertical)

    def predict_motion(
        self,
        source: SourceFrame,
        latents: Tensor,
        states: Tensor,
        actions: Tensor,
        knows_actions: Tensor,
    ) -> Conditioning:
        """Predict the motion and warp the newest frame by it, once for all steps of a sample.

        Latents and states are as in ``sample``. Actions [B, frames, 4] are of about unit scale, and
        ignored if ``knows_actions`` [B] is False. It takes about as long as two denoising steps,
        because each warped frame is encoded.
        """
        with torch.autocast(latents.device.type, enabled=False):  # angles need full precision
            features = context_features(states, self.config.contract)
            predicted = self.motion_predictor(features, actions, knows_actions)
        with torch.no_grad():
            motion = predicted * self.motion_std + self.motion_mean
            pixels, in_view = self.warp(source, self.poses(states[:, -1], motion))
            mean, _ = self.autoencoder.posterior(_channels_last(pixels.flatten(0, 1)))
            warped = self.autoencoder.normalise(mean.float())
        return Conditioning(
            latents=latents,
            features=features,
            knows_actions=knows_actions,
            predicted_motion=predicted,
            warped=warped.reshape(*pixels.shape[:2], *self.config.latent_shape),
            in_view=F.avg_pool2d(in_view.float(), FACTOR).unsqueeze(2),
        )

    def poses(self, state: Tensor, motion: Tensor) -> Poses:
        """Return the poses after motions [B, frames, 15] in SI units from a state [B, 13]."""
        with torch.autocast(state.device.type, enabled=False):
            return poses_after(state, motion, self.config.frame_dt_s)

    def warp(self, source: SourceFrame, poses: Poses) -> tuple[Tensor, Tensor]:
        """Return frames [B, N, 3, H, W], and a bool mask of their pixels in view [B, N, H, W]."""
        with torch.autocast(source.pixels.device.type, enabled=False):
            return self.frame_warp.warp(source, poses)

    def denoise(self, noisy: Future, timestep: Tensor, known: Conditioning) -> Future:
        """Estimate the clean future, x_0, by one network call.

        The network gives latents as a change of the warped frame, in units of their typical change
        over the same number of frames, and the motion as a change of the predicted one. Given the
        actions, little of a future is random: predicting x_0 works at every noise level, and few
        steps lose little.

        Known actions in ``noisy`` are clean; ``timestep`` is [B] int64.
        """
        output = self.dynamics(noisy, timestep, known)
        return Future(
            latents=known.warped + self.change_std * output.latents,
            motion=known.predicted_motion + output.motion,
            actions=torch.where(known.knows_actions.view(-1, 1, 1), noisy.actions, output.actions),
        )

    def normalise_actions(self, actions: Tensor) -> Tensor:
        """Scale sticks [..., 4] to about unit scale."""
        return (actions - self.action_mean) / self.action_std

    def normalise_motion(self, motion: Tensor) -> Tensor:
        """Scale motions [..., frames, 15] to about unit scale."""
        return (motion - self.motion_mean) / self.motion_std

    def _ddim_update(self, step: DdimStep, noisy: Future, known: Conditioning) -> Future:
        timestep = torch.full((len(noisy.latents),), step.timestep, device=noisy.latents.device)
        clean = self.denoise(noisy, timestep, known)

        def update(current: Tensor, estimate: Tensor) -> Tensor:
            return self.config.schedule.ddim_update(step, current, estimate, limit=LIMIT)

        actions = update(noisy.actions, clean.actions)
        return Future(
            latents=update(noisy.latents, clean.latents),
            motion=update(noisy.motion, clean.motion),
            actions=torch.where(known.knows_actions.view(-1, 1, 1), noisy.actions, actions),
        )

    def _initial_noise(self, batch: int, seed: int, device: torch.device) -> Future:
        """Draw the noise of latents first, so that it is equal in both roles."""
        generator, frames = torch.Generator().manual_seed(seed), self.config.frames

        def draw(*shape: int) -> Tensor:
            return torch.randn(batch, frames, *shape, generator=generator).to(device)

        return Future(
            latents=draw(*self.config.latent_shape),
            motion=draw(MOTION_DIM),
            actions=draw(ACTION_DIM),
        )


def _one_by_one(net: Callable[[Tensor], Tensor], inputs: Tensor) -> Tensor:
    """Apply a network to each item of [N, C, H, W] alone, so that results are bit-identical.

    Kernels for other batch sizes may round differently. Kernels also depend on the strides, which
    a slice inherits from its batch, so each item is copied.
    """
    if len(inputs) == 0:
        return net(_channels_last(inputs.new_zeros(1, *inputs.shape[1:])))[:0]
    return torch.cat([net(_channels_last(each[None])) for each in inputs])


def _channels_last(images: Tensor) -> Tensor:
    """Return a copy of [N, C, H, W] in channels-last memory, as the convolutions use it."""
    return images.clone(memory_format=torch.channels_last)
