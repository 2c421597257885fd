"""LeRobot's DiffusionPolicy (Chi et al. 2023): image encoders, and a solve by DDIM.

LeRobot's own default is DDPM with all the steps of training, which takes seconds and ends somewhere
else each time. Here a solve is what LeRobot computes with noise_scheduler_type DDIM: deterministic,
in few steps, from one fixed noise. Parameters have LeRobot's names.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.contract import ACTION_DIM
from policy.errors import PolicyError
from policy.foreign.lerobot.backbone import Backbone, torchvision_name
from policy.foreign.lerobot.config import DiffusionConfig, map_size
from policy.foreign.lerobot.unet import UNet


class SpatialSoftmax(nn.Module):
    """Map [B, C, h, w] -> the mean place of each keypoint, x and y in [-1, 1] [B, 2 K]."""

    def __init__(self, channels: int, keypoints: int, height: int, width: int) -> None:
        super().__init__()
        self.nets = nn.Conv2d(channels, keypoints, 1)
        self.pos_grid: Tensor
        self.register_buffer("pos_grid", torch.zeros(height * width, 2))  # comes with the weights

    def forward(self, cells: Tensor) -> Tensor:
        """A softmax over the cells weighs their places."""
        shares = self.nets(cells).flatten(2).softmax(dim=-1)
        places: Tensor = (shares @ self.pos_grid).flatten(1)
        return places


class RgbEncoder(nn.Module):
    """Normalised image [B, 3, H, W] -> feature [B, 2 * keypoints]."""

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        self.resize, self.crop = config.resize_shape, config.crop_shape
        keypoints = config.spatial_softmax_num_keypoints
        self.backbone = Backbone(config.vision_backbone, group_norm=config.use_group_norm)
        cells = map_size(*config.encoded_size)
        self.pool = SpatialSoftmax(self.backbone.channels, keypoints, *cells)
        self.out = nn.Linear(2 * keypoints, 2 * keypoints)

    def forward(self, image: Tensor) -> Tensor:
        """Resize, crop the middle, encode."""
        if self.resize is not None and self.resize != tuple(image.shape[-2:]):
            image = F.interpolate(image, self.resize, mode="bilinear", antialias=True)
        if self.crop is not None:
            height, width = self.crop
            # As torchvision's CenterCrop: a middle between two pixels is rounded to even.
            top = round((int(image.shape[-2]) - height) / 2)
            left = round((int(image.shape[-1]) - width) / 2)
            image = image[..., top : top + height, left : left + width]
        return F.relu(self.out(self.pool(self.backbone(image))))


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """A reverse step from ``timestep``: sqrt(a) and sqrt(1 - a) of the noise before and after."""

    timestep: int
    signal: float
    noise: float
    next_signal: float
    next_noise: float


def ddim_steps(config: DiffusionConfig, count: int) -> list[Step]:
    """The steps of a solve, noisiest first, at the timesteps that LeRobot's DDIM takes.

    Those are multiples of the spacing from 0 on, so a solve of few steps does not begin at the
    noisiest one. Computed in float32, as LeRobot's schedule is.

    Raises:
        PolicyError: more steps than in training.
    """
    total = config.num_train_timesteps
    if not 1 <= count <= total:
        raise PolicyError(
            f"num_diffusion_steps must be an integer in 1..{total}, the steps of its training; got "
            f"{count}"
        )
    power = torch.cumprod(1 - _betas(config), dim=0)
    signal, noise = power.sqrt().tolist(), (1 - power).sqrt().tolist()
    spacing = total // count
    return [
        Step(
            timestep=t,
            signal=signal[t],
            noise=noise[t],
            next_signal=signal[t - spacing] if t >= spacing else 1.0,
            next_noise=noise[t - spacing] if t >= spacing else 0.0,
        )
        for t in reversed(range(0, spacing * count, spacing))
    ]


def _betas(config: DiffusionConfig) -> Tensor:
    total, low, high = config.num_train_timesteps, config.beta_start, config.beta_end
    if config.beta_schedule == "linear":
        return torch.linspace(low, high, total, dtype=torch.float32)
    if config.beta_schedule == "scaled_linear":
        return torch.linspace(low**0.5, high**0.5, total, dtype=torch.float32) ** 2

    def power(share: float) -> float:  # Nichol & Dhariwal 2021, section 3.2
        return math.cos((share + 0.008) / 1.008 * math.pi / 2) ** 2

    shares = [power((t + 1) / total) / power(t / total) for t in range(total)]
    return torch.tensor([min(1 - share, 0.999) for share in shares], dtype=torch.float32)


class Diffusion(nn.Module):
    """Normalised images and states -> normalised actions."""

    prefix = "diffusion."
    """Before the names of its parameters in LeRobot's file."""
    initial_noise: Tensor
    """[1, predicted, 4]; the same for a whole flight."""

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        self.config = config
        cameras, separate = (
            len(config.features.image_keys),
            config.use_separate_rgb_encoder_per_camera,
        )
        self.rgb_encoder: nn.Module = RgbEncoder(config)
        if separate:
            self.rgb_encoder = nn.ModuleList(RgbEncoder(config) for _ in range(cameras))
        each = (config.features.state_dim or 0) + cameras * config.feature_dim
        self.unet = UNet(config, each * config.n_obs_steps)
        noise = torch.zeros(1, config.predicted, ACTION_DIM)
        self.register_buffer("initial_noise", noise, persistent=False)

    @staticmethod
    def own_name(name: str) -> str | None:
        """Of a parameter in LeRobot's file, without the prefix; None: inference needs it not."""
        name = name.replace("unet._orig_mod.", "unet.")  # of a policy that was compiled
        before, dot, after = name.partition("backbone.")
        return before + dot + torchvision_name(after) if dot else name

    def seed_noise(self, seed: int) -> None:
        """Draw the noise of a flight."""
        generator = torch.Generator().manual_seed(seed)
        noise = torch.randn(self.initial_noise.shape, generator=generator)
        self.initial_noise.copy_(noise)

    def encode(self, image: Tensor, camera: int) -> Tensor:
        """[B, 3, H, W] of one camera -> feature [B, F]."""
        encoders = self.rgb_encoder
        encoder = encoders[camera] if isinstance(encoders, nn.ModuleList) else encoders
        feature: Tensor = encoder(image)
        return feature

    def act(self, feature: Tensor, state: Tensor, num_diffusion_steps: int) -> Tensor:
        """Features [B, T, cameras, F] and states [B, T, S] -> actions from now on [B, horizon, 4].

        Raises:
            PolicyError: more steps than in training.
        """
        condition = torch.cat([state, feature.flatten(2)], dim=-1).flatten(1)
        of_condition = self.unet.film_of_condition(condition)
        sample = self.initial_noise.expand(condition.shape[0], -1, -1)
        for step in ddim_steps(self.config, num_diffusion_steps):
            of_timestep = self.unet.film_of_timestep(step.timestep)
            films = [a + b for a, b in zip(of_timestep, of_condition, strict=True)]
            sample = self._stepped(step, sample, self.unet(sample, films))
        return sample[:, self.config.n_obs_steps - 1 :]

    def _stepped(self, step: Step, noisy: Tensor, output: Tensor) -> Tensor:
        """DDIM with eta = 0 (Song et al. 2021, eq. 12).

        The noise is that of the estimate before it is clipped.
        """
        if self.config.prediction_type == "epsilon":
            clean, noise = (noisy - step.noise * output) / step.signal, output
        else:
            clean, noise = output, (noisy - step.signal * output) / step.noise
        if self.config.clip_sample:
            limit = self.config.clip_sample_range
            clean = clean.clamp(-limit, limit)
        return step.next_signal * clean + step.next_noise * noise
