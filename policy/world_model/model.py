"""A latent world model: what the camera will see and how the vehicle will move.

    frames --encode--> latents --sample--> 16 latents, states and actions --decode--> frames

Two frames and states are the context. One net plays both roles: *simulation*, where the actions are
given and latents and states are denoised, and *decision*, where the actions are denoised too.

Before it denoises, the model foresees the motion and moves the newest frame by it: what was in view
already is carried along, sharp as it is, and the denoiser has to paint the rest.
"""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import ACTION_DIM, STATE_DIM
from policy.errors import PolicyError
from policy.nets.diffusion import DdimStep
from policy.world_model.autoencoder import FACTOR, FrameAutoencoder, to_bytes, to_unit
from policy.world_model.config import WorldModelConfig
from policy.world_model.dynamics import Future, LatentDynamics, Past
from policy.world_model.frame_warp import CarriedView, Poses, View
from policy.world_model.motion_predictor import Foresight
from policy.world_model.relative_state import (
    MOTION_DIM,
    MOTION_SCALE,
    context_features,
    features_dim,
    poses_after,
    state_after,
    vertical_in_body,
)

LIMIT = 6.0
"""Estimates of what has unit scale are clipped to so many standard deviations."""


@dataclass(frozen=True, kw_only=True)
class Imagined:
    """One imagined future of each of ``B`` flights."""

    latents: Tensor
    """[B, frames, C, h, w] as ``encode`` makes them."""
    states: Tensor
    """[B, frames, 13] in SI units, in the contract's frame."""
    actions: Tensor
    """[B, frames, 4] sticks: those that were given, or those that were decided."""
    video: Tensor | None
    """[B, frames, H, W, 3] uint8, None unless it was asked for."""


class WorldModel(nn.Module):
    """Autoencoder and dynamics; everything that they need to know is in the weights."""

    def __init__(self, config: WorldModelConfig) -> None:
        super().__init__()
        self.config = config
        self.autoencoder = FrameAutoencoder(config.latent_channels, config.autoencoder_widths)
        self.autoencoder.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.dynamics = LatentDynamics(
            frames=config.frames,
            context_frames=config.context_frames,
            latent_channels=config.latent_channels,
            latent_side=config.latent_side,
            patch=config.patch,
            width=config.dynamics_width,
            depth=config.dynamics_depth,
        )
        self.foresight = Foresight(
            features=features_dim(config.context_frames), frames=config.frames
        )
        self.carried_view = CarriedView(
            latent_channels=config.latent_channels,
            latent_side=config.latent_side,
            image_size=config.image_size,
            horizontal_fov_rad=config.horizontal_fov_rad,
            camera_tilt_rad=config.camera_tilt_rad,
            state_frame=config.contract.state_frame,
        )
        self.motion_mean: Tensor
        self.motion_std: Tensor
        self.action_mean: Tensor
        self.action_std: Tensor
        self.change_std: Tensor
        self.register_buffer("motion_mean", torch.zeros(config.frames, MOTION_DIM))
        self.register_buffer("motion_std", torch.tensor(MOTION_SCALE).repeat(config.frames, 1))
        self.register_buffer("action_mean", torch.zeros(ACTION_DIM))
        self.register_buffer("action_std", torch.full((ACTION_DIM,), 0.5))
        self.register_buffer("change_std", torch.ones(config.frames, config.latent_channels, 1, 1))

    @torch.no_grad()
    def encode(self, images: Tensor) -> Tensor:
        """Frames [N, H, W, 3] uint8 -> latents [N, C, h, w] of about unit scale.

        Frame by frame, so that a frame's latents do not depend on its neighbours in a batch.

        Raises:
            PolicyError: not uint8 frames of the model's size.
        """
        size = self.config.image_size
        if images.dtype != torch.uint8 or tuple(images.shape[1:]) != (size, size, 3):
            raise PolicyError(
                f"frames must be uint8 [N, {size}, {size}, 3], got {images.dtype} "
                f"{list(images.shape)}: resize them with policy.preprocess.resize"
            )
        coder = self.autoencoder
        # A contiguous copy of each: kernels are chosen by the strides, which tell of the batch.
        means = [coder.posterior(_in_one_layout(to_unit(image[None])))[0] for image in images]
        if not means:
            return torch.empty(0, *self._latent_shape, device=images.device)
        return coder.normalise(torch.cat(means))

    @torch.no_grad()
    def decode(self, latents: Tensor) -> Tensor:
        """Latents [N, C, h, w] -> frames [N, H, W, 3] uint8.

        Frame by frame: kernels for batches of other sizes may round otherwise, and a frame is to be
        the same, bit for bit, with whatever others it is decoded.

        Raises:
            PolicyError: not latents of the model's shape.
        """
        if tuple(latents.shape[1:]) != self._latent_shape:
            raise PolicyError(
                f"latents must be [N, {', '.join(map(str, self._latent_shape))}], got "
                f"{list(latents.shape)}"
            )
        coder = self.autoencoder
        frames = [
            to_bytes(coder.reconstruct(_in_one_layout(coder.denormalise(latent[None]))))
            for latent in latents
        ]
        if not frames:
            size = self.config.image_size
            return torch.empty(0, size, size, 3, dtype=torch.uint8, device=latents.device)
        return torch.cat(frames)

    @torch.no_grad()
    def sample(
        self,
        latents: Tensor,
        states: Tensor,
        actions: Tensor | None,
        *,
        ddim_steps: int,
        noise_seed: int | torch.Generator,
        sim_mode: bool,
        decode_video: bool = False,
    ) -> Imagined:
        """Imagine one future.

        Args:
            latents: [B, context_frames, C, h, w] of the last frames, oldest first.
            states: [B, context_frames, 13] at their exposures, SI units, the contract's frame.
            actions: [B, frames, 4] in simulation, None in decision.
            ddim_steps: network calls.
            noise_seed: of the initial noise; the same on every device. A generator is advanced.
            sim_mode: the role: actions are given, or decided.
            decode_video: whether to decode all frames.

        Raises:
            PolicyError: shapes or steps that do not fit, or actions in the wrong role.
        """
        self._require_context(latents, states, actions, sim_mode=sim_mode)
        steps = self.config.schedule.ddim_steps(ddim_steps)
        batch, device = len(latents), latents.device
        noisy = self._initial_noise(batch, noise_seed, device)
        if actions is not None:
            noisy = Future(
                latents=noisy.latents, motion=noisy.motion, actions=self.normalise_actions(actions)
            )
        knows_actions = torch.full((batch,), sim_mode, device=device)
        view = self.view(latents[:, -1], states[:, -1])
        past = self.foresee(view, latents, states, noisy.actions, knows_actions)
        for step in steps:
            noisy = self._ddim_update(step, noisy, past)
        motion = noisy.motion * self.motion_std + self.motion_mean
        decided = (noisy.actions * self.action_std + self.action_mean).clamp(-1.0, 1.0)
        video = self.decode(noisy.latents.flatten(0, 1)) if decode_video else None
        return Imagined(
            latents=noisy.latents,
            states=state_after(states[:, -1:], motion),
            actions=decided if actions is None else actions,
            video=None if video is None else video.reshape(batch, -1, *video.shape[1:]),
        )

    def foresee(
        self,
        view: View,
        latents: Tensor,
        states: Tensor,
        actions: Tensor,
        knows_actions: Tensor,
    ) -> Past:
        """What is known before anything is denoised: the same for every step of a sample.

        Takes about as long as two of these steps: each frame that was moved is encoded.

        Args:
            view: the newest frame.
            latents: [B, context_frames, C, h, w] of the last frames, oldest first.
            states: [B, context_frames, 13] at their exposures, SI units, the contract's frame.
            actions: [B, frames, 4] of about unit scale; anything where they are not known.
            knows_actions: [B] bool.
        """
        with torch.autocast(latents.device.type, enabled=False):  # angles need all their digits
            features = context_features(states, self.config.contract)
            foreseen = self.foresight(features, actions, knows_actions)
        with torch.no_grad():
            motion = foreseen * self.motion_std + self.motion_mean
            poses = self.poses(states[:, -1], motion)
            carried, in_view = self._carried(view, poses)
        return Past(
            latents=latents,
            features=features,
            knows_actions=knows_actions,
            foreseen=foreseen,
            carried=carried,
            in_view=in_view,
        )

    def view(self, latents: Tensor, state: Tensor) -> View:
        """The newest frame [B, C, h, w], seen in state [B, 13], as ``CarriedView`` moves it."""
        coder = self.autoencoder
        with torch.no_grad():
            pixels = coder.reconstruct(_in_one_layout(coder.denormalise(latents)))
        with torch.autocast(latents.device.type, enabled=False):
            vertical = vertical_in_body(state)
            return self.carried_view.view(pixels.float().clamp(-1.0, 1.0), latents, vertical)

    def poses(self, state: Tensor, motion: Tensor) -> Poses:
        """Where motions [B, frames, 15] in SI units lead from a state [B, 13]."""
        with torch.autocast(state.device.type, enabled=False):
            rotation, position_m = poses_after(state, motion, self.config.frame_dt_s)
        progress = torch.arange(1, motion.shape[1] + 1, device=state.device) / motion.shape[1]
        return Poses(
            rotation=rotation, position_m=position_m, progress=progress.expand(len(state), -1)
        )

    def moved(self, view: View, poses: Poses) -> tuple[Tensor, Tensor]:
        """Frames [B, N, 3, H, W], and where in them was in view [B, N, H, W] bool."""
        with torch.autocast(view.pixels.device.type, enabled=False):
            return self.carried_view.moved(view, poses)

    def denoise(self, noisy: Future, timestep: Tensor, past: Past) -> Future:
        """One network call: the estimate of the clean future, x_0.

        The net tells latents as a change of the frame that was carried along, in units of how much
        they change in so many steps, and the motion as a change of what was foreseen: one that
        knows nothing says that all is as it seemed. Given the actions most of a future is no matter
        of chance, so x_0 is what it can tell best at every level of noise, and few steps lose
        little.

        Args:
            noisy: the future as ``Future`` has it; known actions in it are clean.
            timestep: [B] int64.
            past: the context.
        """
        output = self.dynamics(noisy, timestep, past)
        return Future(
            latents=past.carried + self.change_std * output.latents,
            motion=past.foreseen + output.motion,
            actions=torch.where(past.knows_actions.view(-1, 1, 1), noisy.actions, output.actions),
        )

    def normalise_actions(self, actions: Tensor) -> Tensor:
        """Sticks [..., 4] -> about unit scale."""
        return (actions - self.action_mean) / self.action_std

    def normalise_motion(self, motion: Tensor) -> Tensor:
        """Motions [..., frames, 15] -> about unit scale."""
        return (motion - self.motion_mean) / self.motion_std

    @property
    def _latent_shape(self) -> tuple[int, int, int]:
        side = self.config.latent_side
        return self.config.latent_channels, side, side

    def _carried(self, view: View, poses: Poses) -> tuple[Tensor, Tensor]:
        """Latents of the moved frames, and how much of each of their cells was in view."""
        pixels, in_view = self.moved(view, poses)
        mean, _ = self.autoencoder.posterior(_in_one_layout(pixels.flatten(0, 1)))
        latents = self.autoencoder.normalise(mean.float())
        share = F.avg_pool2d(in_view.float(), FACTOR)
        return latents.reshape(*pixels.shape[:2], *self._latent_shape), share.unsqueeze(2)

    def _ddim_update(self, step: DdimStep, noisy: Future, past: Past) -> Future:
        timestep = torch.full((len(noisy.latents),), step.timestep, device=noisy.latents.device)
        clean = self.denoise(noisy, timestep, past)
        update = self.config.schedule.ddim_update
        actions = torch.where(
            past.knows_actions.view(-1, 1, 1),
            noisy.actions,
            update(step, noisy.actions, clean.actions, limit=LIMIT),
        )
        return Future(
            latents=update(step, noisy.latents, clean.latents, limit=LIMIT),
            motion=update(step, noisy.motion, clean.motion, limit=LIMIT),
            actions=actions,
        )

    def _initial_noise(
        self, batch: int, seed: int | torch.Generator, device: torch.device
    ) -> Future:
        """Drawn in one order, so that both roles begin with the same noise of latents."""
        generator = seed
        if not isinstance(generator, torch.Generator):
            generator = torch.Generator().manual_seed(generator)
        frames = self.config.frames

        def draw(*shape: int) -> Tensor:
            drawn = torch.randn(batch, frames, *shape, generator=generator, device=generator.device)
            return drawn.to(device)

        return Future(
            latents=draw(*self._latent_shape), motion=draw(MOTION_DIM), actions=draw(ACTION_DIM)
        )

    def _require_context(
        self, latents: Tensor, states: Tensor, actions: Tensor | None, *, sim_mode: bool
    ) -> None:
        batch, past, frames = len(latents), self.config.context_frames, self.config.frames
        if sim_mode == (actions is None):
            raise PolicyError(
                "simulation (sim_mode=True) takes the actions, decision (sim_mode=False) makes "
                f"them: actions are {'missing' if actions is None else 'not to be given'}"
            )
        wanted = {"latents": (batch, past, *self._latent_shape), "states": (batch, past, STATE_DIM)}
        given = {"latents": latents, "states": states}
        if actions is not None:
            wanted["actions"], given["actions"] = (batch, frames, ACTION_DIM), actions
        for name, array in given.items():
            if tuple(array.shape) != wanted[name]:
                raise PolicyError(f"{name} must be {list(wanted[name])}, got {list(array.shape)}")


def _in_one_layout(images: Tensor) -> Tensor:
    """A copy of [N, C, H, W] in the one memory layout that the convolutions are run in."""
    return images.clone(memory_format=torch.channels_last)
