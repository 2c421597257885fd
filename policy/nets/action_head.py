"""Diffusion action head: a condition vector in, a chunk of stick positions out."""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM, Contract
from policy.errors import PolicyError
from policy.nets.diffusion import NoiseSchedule, ddim_solve, flight_noise
from policy.nets.names import SIZE_NAMES, Size
from policy.nets.unet1d import UNet1d


@dataclass(frozen=True, slots=True, kw_only=True)
class SizeDims:
    """Network dimensions of one size."""

    base_dim: int
    """Width of the feature, the tokens and the condition."""
    widths: tuple[int, ...]
    """Channels of the U-Net's levels."""


def size_dims(size: Size) -> SizeDims:
    """Return the dimensions of a size: heads of about 3, 12 and 40 million parameters.

    On a CPU every diffusion step reads all weights once: 100 Hz with 10 steps allows about 3
    million weights on one core.
    """
    match size:
        case "small":
            return SizeDims(base_dim=256, widths=(96, 160, 256))
        case "medium":
            return SizeDims(base_dim=384, widths=(192, 320, 512))
        case "large":
            return SizeDims(base_dim=512, widths=(320, 640, 960))
        case _:
            raise PolicyError(f"size {size!r} is unknown; use one of {list(SIZE_NAMES)}")


class DiffusionHead(nn.Module):
    """Denoiser, noise schedule and initial noise.

    If the net predicts the clean chunk, its prediction is the sum of a linear layer's output for
    the condition and the U-Net's output for the noisy chunk. The linear layer learns the mean chunk
    within minutes, and the U-Net learns the deviations from it, which are zero at the noisiest
    step. So a head steers in few steps and after little training.

    The initial noise is fixed for a flight: equal inputs then give equal sticks, and chunks do not
    jitter from sample to sample. It is not part of a checkpoint. Steps that the schedule does not
    have raise a ``PolicyError``.
    """

    def __init__(self, size: Size, contract: Contract, schedule: NoiseSchedule) -> None:
        super().__init__()
        dims = size_dims(size)
        self.schedule = schedule
        self.unet = UNet1d(
            horizon=contract.horizon, condition_dim=dims.base_dim, widths=dims.widths
        )
        self.direct = nn.Linear(dims.base_dim, contract.horizon * ACTION_DIM)
        timesteps = torch.arange(schedule.num_train_timesteps)
        self._timesteps = nn.Buffer(timesteps, persistent=False)
        self.initial_noise = nn.Buffer(flight_noise(0, contract.horizon), persistent=False)

    def seed_noise(self, seed: int) -> None:
        """Draw the initial noise of a flight."""
        self.initial_noise.copy_(flight_noise(seed, self.initial_noise.shape[1]))

    def denoise(self, noisy: Tensor, timestep: Tensor, condition: Tensor) -> Tensor:
        """Call the network: [B, horizon, 4], [B] int64, [B, C] -> the schedule's prediction."""
        film = self.unet.film_of_timestep(timestep) + self.unet.film_of_condition(condition)
        prediction: Tensor = self.unet(noisy, film)
        return prediction + self.read(condition) if self.reads_condition else prediction

    @property
    def reads_condition(self) -> bool:
        """True if ``read`` is part of the prediction, which is then the clean chunk."""
        return self.schedule.prediction == "sample"

    def read(self, condition: Tensor) -> Tensor:
        """Return the mean chunk [B, horizon, 4] for a condition [B, C]."""
        chunk: Tensor = self.direct(condition)
        return chunk.reshape(condition.shape[0], -1, ACTION_DIM)

    def sample(self, condition: Tensor, num_diffusion_steps: int) -> Tensor:
        """Sample a chunk [B, horizon, 4] in [-1, 1] for a condition [B, C]."""
        noise = self.initial_noise.expand(condition.shape[0], -1, -1)
        steps = self.schedule.ddim_steps(num_diffusion_steps)
        # Selected on the device: a CUDA graph capture allows no copy from the host.
        timesteps = torch.stack([self._timesteps[step.timestep] for step in steps])
        # Both parts of FiLM are outside the loop; one product serves all timesteps.
        film_of_step = self.unet.film_of_timestep(timesteps).unsqueeze(1)
        film_of_condition = self.unet.film_of_condition(condition)
        read = self.read(condition) if self.reads_condition else 0.0

        def denoise(index: int, noisy: Tensor) -> Tensor:
            prediction: Tensor = self.unet(noisy, film_of_step[index] + film_of_condition)
            return prediction + read

        return ddim_solve(self.schedule, steps, denoise, noise)
