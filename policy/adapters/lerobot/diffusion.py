"""LeRobot's DiffusionPolicy (Chi et al. 2023): image encoders, and a solve by DDIM.

LeRobot's own default is DDPM with all the steps of training, which takes seconds and ends somewhere
else each time. Here a solve is what LeRobot computes with noise_scheduler_type DDIM: deterministic,
in few steps, from one fixed noise. Parameters have LeRobot's names.
"""

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.adapters.lerobot.backbone import Backbone, torchvision_name
from policy.adapters.lerobot.config import DiffusionConfig, map_size
from policy.adapters.lerobot.schedule import DdimSchedule
from policy.adapters.lerobot.unet import UNet
from policy.contract import ACTION_DIM, EXTRA_NAMES


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


class Diffusion(nn.Module):
    """Normalised images and states -> normalised actions."""

    prefix = "diffusion."
    """Before the names of its parameters in LeRobot's file."""
    initial_noise: Tensor
    """[1, predicted, 4]; the same for a whole flight."""

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        self.steps_before_now = config.n_obs_steps - 1
        self.schedule = DdimSchedule(config)
        cameras = len(config.features.image_keys)
        self.rgb_encoder: nn.Module = nn.Identity()
        if cameras and config.use_separate_rgb_encoder_per_camera:
            self.rgb_encoder = nn.ModuleList(RgbEncoder(config) for _ in range(cameras))
        elif cameras:
            self.rgb_encoder = RgbEncoder(config)
        each = (config.features.state_dim or 0) + cameras * config.feature_dim
        each += len(EXTRA_NAMES["goal"]) if config.features.takes_goal else 0
        self.unet = UNet(config, each * config.n_obs_steps)
        noise = torch.zeros(1, config.predicted, ACTION_DIM)
        self.register_buffer("initial_noise", noise, persistent=False)

    @staticmethod
    def own_name(name: str) -> str | None:
        """Our name of a parameter in LeRobot's file, without the prefix; None: not needed."""
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

    def film_of_condition(self, feature: Tensor, state: Tensor) -> list[Tensor]:
        """Features [B, T, cameras, F] and states [B, T, S] -> their share of FiLM."""
        condition = torch.cat([state, feature.flatten(2)], dim=-1).flatten(1)
        return self.unet.film_of_condition(condition)

    def denoise(self, noisy: Tensor, timestep: Tensor, of_condition: list[Tensor]) -> Tensor:
        """One call of the network: noisy actions [B, predicted, 4] at timesteps [B]."""
        of_timestep = self.unet.film_of_timestep(timestep)
        films = [a + b for a, b in zip(of_timestep, of_condition, strict=True)]
        prediction: Tensor = self.unet(noisy, films)
        return prediction

    def act(self, feature: Tensor, state: Tensor, num_diffusion_steps: int) -> Tensor:
        """A whole solve -> actions from now on [B, horizon, 4]."""
        of_condition = self.film_of_condition(feature, state)
        sample = self.initial_noise.expand(feature.shape[0], -1, -1)
        for step in self.schedule.ddim_steps(num_diffusion_steps):
            timestep = torch.full((1,), float(step.timestep), device=sample.device)
            output = self.denoise(sample, timestep, of_condition)
            sample = self.schedule.ddim_update(step, sample, output)
        return self.from_now(sample)

    def from_now(self, sample: Tensor) -> Tensor:
        """Without the actions at the earlier observations: [B, predicted, 4] -> [B, horizon, 4]."""
        return sample[:, self.steps_before_now :]
