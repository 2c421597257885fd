"""A latent world model: what the camera will see and how the vehicle will move.

    frames --encode--> latents --sample--> 16 latents, states and actions --decode--> frames

Two frames and states are the context. One net plays both roles: *simulation*, where the actions are
given and latents and states are denoised, and *decision*, where the actions are denoised too.
"""

import json
import math
from dataclasses import asdict, dataclass, field, fields

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM, STATE_DIM, Contract, PolicyError
from policy.diffusion import DdimStep, NoiseSchedule
from policy.frame_autoencoder import FACTOR, FrameAutoencoder, to_bytes, to_unit
from policy.latent_dynamics import HEAD_DIM, Future, LatentDynamics, Past
from policy.relative_state import MOTION_DIM, MOTION_SCALE, context_features, state_after

LIMIT = 6.0
"""Estimates of what has unit scale are clipped to so many standard deviations."""


@dataclass(frozen=True, kw_only=True)
class WorldModelConfig:
    """Shape of a world model.

    Raises:
        PolicyError: a field is out of its range.
    """

    image_size: int = 64
    """Side of the square frames, px."""
    latent_channels: int = 8
    frames: int = 16
    """Frames, states and actions in one imagined future."""
    context_frames: int = 2
    """Frames and states of the past, the newest of them now."""
    frame_dt_s: float = 0.1
    """Time between two frames. Action k is the mean stick from frame k - 1 (the last of the context
    for k = 0) to frame k, state k is that at the exposure of frame k."""
    autoencoder_widths: tuple[int, int, int] = (24, 40, 56)
    patch: int = 2
    """Latents on a side of one token."""
    dynamics_width: int = 128
    dynamics_depth: int = 5
    contract: Contract = field(default_factory=Contract)
    """Its ``state_frame`` is the states'; a model and a policy of two frames do not go together.
    What else it says is about policies: ``image_size`` and ``frame_dt_s`` are the model's own."""
    schedule: NoiseSchedule = field(default_factory=NoiseSchedule)

    def __post_init__(self) -> None:
        """Refuse what cannot be built."""
        for name, low, high in (
            ("image_size", 16, 1024),
            ("latent_channels", 1, 64),
            ("frames", 1, 256),
            ("context_frames", 1, 16),
            ("patch", 1, 8),
            ("dynamics_width", HEAD_DIM, 4096),
            ("dynamics_depth", 1, 64),
        ):
            value = getattr(self, name)
            if not isinstance(value, int) or not low <= value <= high:
                raise PolicyError(f"{name} must be an integer in {low}..{high}, got {value!r}")
        if self.image_size % (FACTOR * self.patch):
            raise PolicyError(
                f"image_size must be a multiple of {FACTOR * self.patch} ({FACTOR} pixels a "
                f"latent, {self.patch} latents a token), got {self.image_size}"
            )
        if self.dynamics_width % HEAD_DIM:
            raise PolicyError(f"dynamics_width must be a multiple of {HEAD_DIM}")
        if len(self.autoencoder_widths) != 3 or min(self.autoencoder_widths) < 1:
            raise PolicyError(f"autoencoder_widths must be three, got {self.autoencoder_widths}")
        if not (math.isfinite(self.frame_dt_s) and 0.01 <= self.frame_dt_s <= 1):
            raise PolicyError(f"frame_dt_s must be 0.01 to 1 second, got {self.frame_dt_s}")
        if self.schedule.prediction != "sample":
            raise PolicyError("the schedule of a world model must predict the sample")

    @property
    def latent_side(self) -> int:
        """Latents on a side of a frame."""
        return self.image_size // FACTOR

    def to_json(self) -> str:
        """Header form of a checkpoint, without the contract."""
        data = {name: value for name, value in asdict(self).items() if name != "contract"}
        return json.dumps(data, sort_keys=True)

    @classmethod
    def from_json(cls, text: str, contract: Contract) -> "WorldModelConfig":
        """Read the header form.

        Raises:
            PolicyError: not of this form, or values out of range.
        """
        try:
            data = json.loads(text)
            known = {each.name for each in fields(cls)} - {"contract"}
            if set(data) != known:
                raise PolicyError(f"it must hold {sorted(known)}, not {sorted(data)}")
            data["schedule"] = NoiseSchedule(**data["schedule"])
            data["autoencoder_widths"] = tuple(data["autoencoder_widths"])
            return cls(contract=contract, **data)
        except (TypeError, ValueError, RecursionError) as error:  # JSON's error is a ValueError
            raise PolicyError(f"malformed world model {text[:200]!r}: {error}") from error


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
        means = [coder.posterior(_alone(to_unit(image[None])))[0] for image in images]
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
            to_bytes(coder.reconstruct(_alone(coder.denormalise(latent[None]))))
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
        past = Past(
            latents=latents,
            features=context_features(states, self.config.contract),
            knows_actions=torch.full((batch,), sim_mode, device=device),
        )
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

    def denoise(self, noisy: Future, timestep: Tensor, past: Past) -> Future:
        """One network call: the estimate of the clean future, x_0.

        The net tells latents as a change of the last frame's, in units of how much they change in
        so many steps: one that knows nothing says that nothing moves. Given the actions most of a
        future is no matter of chance, so x_0 is what it can tell best at every level of noise, and
        few steps lose little.

        Args:
            noisy: the future as ``Future`` has it; known actions in it are clean.
            timestep: [B] int64.
            past: the context.
        """
        output = self.dynamics(noisy, timestep, past)
        return Future(
            latents=past.latents[:, -1:] + self.change_std * output.latents,
            motion=output.motion,
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


def _alone(image: Tensor) -> Tensor:
    """A copy of [1, C, H, W] in the one memory layout that the convolutions are run in."""
    return image.clone(memory_format=torch.channels_last)
