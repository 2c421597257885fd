"""The steps of a solve as LeRobot computes them with noise_scheduler_type DDIM."""

import math
from typing import Any

import torch
from torch import Tensor

from policy.adapters.lerobot.config import DiffusionConfig
from policy.errors import PolicyError
from policy.nets.diffusion import Chunk, DdimStep


class DdimSchedule:
    """DDIM with eta = 0 (Song et al. 2021, eq. 12), for ``policy.protocol.StepwisePolicy``.

    It differs from ``nets.diffusion.NoiseSchedule`` in the timesteps, in the noise, which is that
    of the estimate before it is clipped, and in its choice of betas.
    """

    def __init__(self, config: DiffusionConfig) -> None:
        self._config = config
        power = torch.cumprod(1 - _betas(config), dim=0)  # in float32, as LeRobot's
        self._signal, self._noise = power.sqrt().tolist(), (1 - power).sqrt().tolist()

    def ddim_steps(self, count: int) -> tuple[DdimStep, ...]:
        """The steps of a solve by ``count`` network calls, noisiest first.

        Their timesteps are multiples of the spacing from 0 on ("leading", Lin et al. 2024), so that
        few steps do not begin at the noisiest one.
        """
        total = self._config.num_train_timesteps
        if not 1 <= count <= total:
            raise PolicyError(
                f"num_diffusion_steps must be an integer in 1..{total}, the steps of its training; "
                f"got {count!r}"
            )
        spacing, signal, noise = total // count, self._signal, self._noise
        return tuple(
            DdimStep(
                timestep=t,
                signal=signal[t],
                noise=noise[t],
                next_signal=signal[t - spacing] if t >= spacing else 1.0,
                next_noise=noise[t - spacing] if t >= spacing else 0.0,
            )
            for t in reversed(range(0, spacing * count, spacing))
        )

    def ddim_update(self, step: DdimStep, noisy: Chunk, output: Chunk) -> Chunk:
        """One reverse step from the net's output."""
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
