"""LeRobot's DiffusionPolicy (Chi et al. 2023): image encoders, a 1-D U-Net and a DDIM solver.

LeRobot's default is DDPM with all training steps, which takes seconds and gives a different result
each time. Here a solve is what LeRobot computes with noise_scheduler_type DDIM: deterministic, in
few steps, from one fixed noise.
"""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from policy.adapters.lerobot.base import LeRobotPolicy
from policy.adapters.lerobot.config import DiffusionConfig, map_size
from policy.adapters.lerobot.plan import Plan
from policy.contract import ACTION_DIM
from policy.errors import PolicyError
from policy.nets.diffusion import Chunk, DdimStep, cosine_power, flight_noise, steps_at
from policy.nets.resnet import LastMap
from policy.nets.unet1d import GroupNorm, sinusoid_frequencies
from policy.protocol import predict_by_steps

_PLACES = {"0": "conv1", "1": "bn1", "4": "layer1", "5": "layer2", "6": "layer3", "7": "layer4"}
"""LeRobot's names of a ResNet's parts, which it keeps in a list, and torchvision's."""
_CHANNELS_PER_GROUP = 16


class Mish(nn.Module):
    """Mish (Misra 2019) of vectors, ``x * tanh(softplus(x))``, without a Mish operation.

    With w = exp(x), tanh(softplus(x)) = w (w + 2) / (w (w + 2) + 2). OpenVINO 2026.4 fails to
    compile a Mish between small matrix products in float32.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Apply Mish to each element."""
        w = x.clamp(max=20.0).exp()  # above, the quotient is 1
        n = w * (w + 2)
        return x * (n / (n + 2))


class ConvBlock(nn.Module):
    """Convolution, norm, Mish; [B, C_in, L] -> [B, C_out, L]."""

    def __init__(self, channels_in: int, channels_out: int, kernel: int, groups: int) -> None:
        super().__init__()
        self.block = nn.Sequential(
            nn.Conv1d(channels_in, channels_out, kernel, padding=kernel // 2),
            GroupNorm(groups, channels_out),
            nn.Mish(),
        )

    def forward(self, x: Tensor) -> Tensor:
        """Apply convolution, norm and Mish."""
        out: Tensor = self.block(x)
        return out


class LerobotResidualBlock(nn.Module):
    """Two convolutions with FiLM between them, around a shortcut."""

    def __init__(
        self, channels_in: int, channels_out: int, config: DiffusionConfig, condition_dim: int
    ) -> None:
        super().__init__()
        kernel, groups = config.kernel_size, config.n_groups
        self.scales = config.use_film_scale_modulation
        self.conv1 = ConvBlock(channels_in, channels_out, kernel, groups)
        self.conv2 = ConvBlock(channels_out, channels_out, kernel, groups)
        film_dim = channels_out * (2 if self.scales else 1)
        # In place of LeRobot's Mish, which the U-Net applies once for all blocks.
        self.cond_encoder = nn.Sequential(nn.Identity(), nn.Linear(condition_dim, film_dim))
        self.residual_conv: nn.Module = nn.Identity()
        if channels_in != channels_out:
            self.residual_conv = nn.Conv1d(channels_in, channels_out, 1)

    def forward(self, x: Tensor, condition: Tensor) -> Tensor:
        """Apply the block, conditioned by an activated embedding [B, condition_dim]."""
        hidden, film = self.conv1(x), self.cond_encoder(condition)
        if self.scales:
            scale, shift = film.unsqueeze(-1).chunk(2, dim=1)
            hidden = scale * hidden + shift
        else:
            hidden = hidden + film.unsqueeze(-1)
        out: Tensor = self.conv2(hidden) + self.residual_conv(x)
        return out


class UNet(nn.Module):
    """Noisy chunk [B, horizon, 4], its timestep and a condition [B, C] -> the net's prediction."""

    def __init__(self, config: DiffusionConfig, condition_dim: int) -> None:
        super().__init__()
        widths, self.time_dim = config.down_dims, config.diffusion_step_embed_dim

        def block(channels_in: int, channels_out: int) -> LerobotResidualBlock:
            return LerobotResidualBlock(
                channels_in, channels_out, config, self.time_dim + condition_dim
            )

        self.diffusion_step_encoder = nn.Sequential(
            nn.Identity(),  # LeRobot's sinusoids, which have no parameters
            nn.Linear(self.time_dim, 4 * self.time_dim),
            Mish(),
            nn.Linear(4 * self.time_dim, self.time_dim),
        )
        self.down_modules, self.mid_modules = nn.ModuleList(), nn.ModuleList()
        self.up_modules = nn.ModuleList()
        for level, (into, out) in enumerate(zip((ACTION_DIM, *widths), widths, strict=False)):
            last = level == len(widths) - 1
            halve = nn.Identity() if last else nn.Conv1d(out, out, 3, stride=2, padding=1)
            self.down_modules.append(nn.ModuleList([block(into, out), block(out, out), halve]))
        self.mid_modules.extend(block(widths[-1], widths[-1]) for _ in range(2))
        for into, out in zip(widths[:0:-1], widths[-2::-1], strict=True):
            double = nn.ConvTranspose1d(out, out, 4, stride=2, padding=1)
            self.up_modules.append(nn.ModuleList([block(2 * into, out), block(out, out), double]))
        self.final_conv = nn.Sequential(
            # Always eight groups, as in LeRobot; config.json's number is ignored.
            ConvBlock(widths[0], widths[0], config.kernel_size, 8),
            nn.Conv1d(widths[0], ACTION_DIM, 1),
        )
        self.activation = Mish()
        self._frequencies = nn.Buffer(sinusoid_frequencies(self.time_dim), persistent=False)

    def forward(self, noisy: Tensor, timestep: Tensor, condition: Tensor) -> Tensor:
        """Predict, at float32 timesteps [1] or [B], for a condition [B, C]."""
        angle = timestep.unsqueeze(-1) * self._frequencies
        embedded = self.diffusion_step_encoder(torch.cat([angle.sin(), angle.cos()], dim=-1))
        seen = [embedded.expand(len(condition), -1), condition]
        active = self.activation(torch.cat(seen, dim=-1))
        x, skips = noisy.transpose(1, 2), []
        layers: Any = self  # its module lists are not typed
        for first, second, halve in layers.down_modules:
            x = second(first(x, active), active)
            skips.append(x)
            x = halve(x)
        for block in layers.mid_modules:
            x = block(x, active)
        for first, second, double in layers.up_modules:
            x = first(torch.cat([x, skips.pop()], dim=1), active)
            x = double(second(x, active))
        out: Tensor = self.final_conv(x)
        return out.transpose(1, 2)


class SpatialSoftmax(nn.Module):
    """Map [B, C, h, w] -> mean position of each keypoint, x and y in [-1, 1], [B, 2 K]."""

    def __init__(self, channels: int, keypoints: int, height: int, width: int) -> None:
        super().__init__()
        self.nets = nn.Conv2d(channels, keypoints, 1)
        self.pos_grid = nn.Buffer(torch.zeros(height * width, 2))  # comes with the weights

    def forward(self, cells: Tensor) -> Tensor:
        """Average the cells' positions, weighted by a softmax over the cells."""
        shares = self.nets(cells).flatten(2).softmax(dim=-1)
        places: Tensor = (shares @ self.pos_grid).flatten(1)
        return places


class RgbEncoder(nn.Module):
    """Normalised image [B, 3, H, W] -> feature [B, 2 * keypoints]."""

    def __init__(self, config: DiffusionConfig) -> None:
        super().__init__()
        self.resize, self.crop = config.resize_shape, config.crop_shape
        keypoints = config.spatial_softmax_num_keypoints
        self.backbone = LastMap(config.vision_backbone)
        if config.use_group_norm:
            _replace_batch_norms(self.backbone)
        cells = map_size(*config.encoded_size)
        self.pool = SpatialSoftmax(self.backbone.channels, keypoints, *cells)
        self.out = nn.Linear(2 * keypoints, 2 * keypoints)

    def forward(self, image: Tensor) -> Tensor:
        """Resize, crop the middle, encode."""
        if self.resize is not None and self.resize != tuple(image.shape[-2:]):
            image = F.interpolate(image, self.resize, mode="bilinear", antialias=True)
        if self.crop is not None:
            height, width = self.crop
            # As torchvision's CenterCrop: half pixels are rounded to even.
            top = round((int(image.shape[-2]) - height) / 2)
            left = round((int(image.shape[-1]) - width) / 2)
            image = image[..., top : top + height, left : left + width]
        return F.relu(self.out(self.pool(self.backbone(image))))


class DdimSchedule:
    """DDIM with eta = 0 (Song et al. 2021, eq. 12), for ``policy.protocol.StepwisePolicy``.

    Differs from ``nets.diffusion.NoiseSchedule`` in the timesteps, the choice of betas, and the
    noise, which is that of the unclipped estimate.
    """

    def __init__(self, config: DiffusionConfig) -> None:
        self._config = config
        power = torch.cumprod(1 - _betas(config), dim=0)  # in float32, as in LeRobot
        self._signal, self._noise = power.sqrt().tolist(), (1 - power).sqrt().tolist()

    def ddim_steps(self, count: int) -> tuple[DdimStep, ...]:
        """Return the steps of a solve with ``count`` network calls, noisiest first.

        The timesteps are multiples of the spacing, starting at 0 ("leading", Lin et al. 2024), so
        few steps do not begin at the noisiest timestep.
        """
        total = self._config.num_train_timesteps
        if not 1 <= count <= total:
            raise PolicyError(
                f"num_diffusion_steps must be an integer in 1..{total}, the steps of its training; "
                f"got {count!r}"
            )
        spacing = total // count
        timesteps = range(0, spacing * count, spacing)[::-1]
        return steps_at(timesteps, self._signal, self._noise)

    def ddim_update(self, step: DdimStep, noisy: Chunk, output: Chunk) -> Chunk:
        """Take one reverse step with the net's output."""
        config = self._config
        clean: Any = output
        noise: Any = output
        if config.prediction_type == "epsilon":
            clean = (noisy - step.noise * output) / step.signal
        else:
            noise = (noisy - step.signal * output) / step.noise
        if config.clip_sample:
            clean = clean.clip(-config.clip_sample_range, config.clip_sample_range)
        after: Chunk = step.next_signal * clean + step.next_noise * noise
        return after


class Diffusion(LeRobotPolicy):
    """DiffusionPolicy behind ``policy.protocol.StepwisePolicy``."""

    prefix = "diffusion."
    initial_noise: Tensor
    """[1, predicted, 4]; fixed for a whole flight."""

    def __init__(self, plan: Plan, config: DiffusionConfig) -> None:
        super().__init__(plan)
        self.steps_before_now = config.n_obs_steps - 1
        self.schedule = DdimSchedule(config)
        cameras = len(config.features.image_keys)
        self.rgb_encoder: nn.Module = RgbEncoder(config)
        if config.use_separate_rgb_encoder_per_camera:
            self.rgb_encoder = nn.ModuleList(RgbEncoder(config) for _ in range(cameras))
        each = (config.features.state_dim or 0) + cameras * config.feature_dim
        self.unet = UNet(config, each * config.n_obs_steps)
        noise = torch.zeros(1, config.predicted, ACTION_DIM)
        self.initial_noise = nn.Buffer(noise, persistent=False)

    @staticmethod
    def own_name(name: str) -> str | None:
        """Return our name of a parameter in LeRobot's file, without the prefix."""
        name = name.replace("unet._orig_mod.", "unet.")  # left by torch.compile
        before, dot, after = name.partition("backbone.")
        place, _, rest = after.partition(".")
        return f"{before}{dot}{_PLACES.get(place, place)}.{rest}" if dot else name

    def seed_noise(self, seed: int) -> None:
        """Draw the initial noise of a flight."""
        self.initial_noise.copy_(flight_noise(seed, self.initial_noise.shape[1]))

    def encode(self, image: Tensor, camera: int) -> Tensor:
        """Encode a normalised image [B, 3, H, W] of one camera -> feature [B, F]."""
        encoders = self.rgb_encoder
        encoder = encoders[camera] if isinstance(encoders, nn.ModuleList) else encoders
        feature: Tensor = encoder(image)
        return feature

    def denoise(
        self,
        noisy: Tensor,
        timestep: Tensor,
        feature: Tensor,
        state: Tensor,
        action_history: Tensor,
    ) -> Tensor:
        """Call the network once on noisy actions [B, predicted, 4] at timesteps [1] or [B]."""
        features, states = self.network_inputs(feature, state)
        condition = torch.cat([states, features.flatten(2)], dim=-1).flatten(1)
        prediction: Tensor = self.unet(noisy, timestep, condition)
        return prediction

    predict_fast = predict_by_steps

    def to_chunk(self, sample: Tensor) -> Tensor:
        """Convert the end of a solve [B, predicted, 4] to a chunk [B, horizon, 4].

        The actions of the earlier observations are dropped.
        """
        return self.in_units(sample[:, self.steps_before_now :])


def _betas(config: DiffusionConfig) -> Tensor:
    total, low, high = config.num_train_timesteps, config.beta_start, config.beta_end
    if config.beta_schedule == "linear":
        return torch.linspace(low, high, total, dtype=torch.float32)
    if config.beta_schedule == "scaled_linear":
        return torch.linspace(low**0.5, high**0.5, total, dtype=torch.float32) ** 2
    shares = [cosine_power((t + 1) / total) / cosine_power(t / total) for t in range(total)]
    return torch.tensor([min(1 - share, 0.999) for share in shares], dtype=torch.float32)


def _replace_batch_norms(module: nn.Module) -> None:
    for name, child in module.named_children():
        if isinstance(child, nn.BatchNorm2d):
            channels = child.num_features
            setattr(module, name, GroupNorm(channels // _CHANNELS_PER_GROUP, channels))
        else:
            _replace_batch_norms(child)
