"""The diffusion process, and the action head: a condition vector in, a chunk of sticks out.

Forward process, DDPM (Ho et al. 2020, eq. 4), with a_t the cumulative product of ``1 - beta``:

    x_t = sqrt(a_t) x_0 + sqrt(1 - a_t) eps

Reverse step from t to s < t, DDIM with eta = 0 (Song et al. 2021, eq. 12):

    x_s = sqrt(a_s) x_0 + sqrt(1 - a_s) eps,   with the net's estimate of x_0 and eps

The last step goes to a_s = 1, so that a sample is the net's last estimate of x_0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import torch
from torch import Tensor, nn

from policy.contract import ACTION_DIM, Contract, FloatArray
from policy.errors import PolicyError
from policy.fields import Between, require_fields
from policy.nets.names import Size
from policy.nets.unet1d import UNet1d

BetaSchedule = Literal["squared_cosine", "linear"]
Prediction = Literal["sample", "epsilon"]

TRAIN_TIMESTEPS = 100
Chunk = TypeVar("Chunk", Tensor, FloatArray)
"""Actions [B, horizon, 4], clean or noisy."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DdimStep:
    """One reverse step: its start, and the coefficients of the state before and after it.

    ``signal`` is sqrt(a_t), ``noise`` sqrt(1 - a_t). They are plain floats, so a tracer folds them
    to constants and float64 stays float64.
    """

    timestep: int
    signal: float
    noise: float
    next_signal: float
    next_noise: float


@dataclass(frozen=True, kw_only=True)
class NoiseSchedule:
    """Noise schedule of the training, and the quantity that the net predicts."""

    num_train_timesteps: Annotated[int, Between(1, 1000)] = TRAIN_TIMESTEPS
    betas: BetaSchedule = "squared_cosine"
    prediction: Prediction = "sample"
    """``sample``: the net returns x_0; ``epsilon``: the noise. With ``epsilon``, the first steps
    divide by sqrt(a_t), which is 5e-4 at t = 99, to get x_0; with few steps ``sample`` is safer."""

    def __post_init__(self) -> None:
        require_fields(self, PolicyError)

    def ddim_steps(self, count: int) -> tuple[DdimStep, ...]:
        """Return the reverse steps of a solve with ``count`` network calls, noisiest first.

        Timesteps are evenly spaced and include the noisiest one ("trailing", Lin et al. 2024), so
        every count starts from pure noise, and count 1 is the net's x_0 of pure noise.
        """
        total = self.num_train_timesteps
        if type(count) is not int or not 1 <= count <= total:
            raise PolicyError(
                f"num_diffusion_steps must be an integer in 1..{total} (the schedule that the "
                f"policy was trained on), got {count!r}; 10 is a good start"
            )
        return _ddim_steps(self, count)

    def add_noise(self, clean: Tensor, noise: Tensor, timestep: Tensor) -> Tensor:
        """Run the forward process, for training: clean [B, ...] and standard noise -> noisy."""
        power = torch.tensor(signal_power(self), dtype=torch.float64, device=clean.device)
        at = power[timestep].reshape(-1, *[1] * (clean.ndim - 1))
        return at.sqrt().to(clean.dtype) * clean + (1 - at).sqrt().to(clean.dtype) * noise

    def ddim_update(
        self, step: DdimStep, noisy: Chunk, output: Chunk, *, limit: float = 1.0
    ) -> Chunk:
        """Take one reverse step with the net's output, both tensors or both arrays.

        x_0 is clipped to [-limit, limit], by default the range of an action, and eps is then
        recomputed, so that both still explain ``noisy``.
        """
        clean: Any = output
        if self.prediction == "epsilon":
            clean = (noisy - step.noise * output) / step.signal
        clean = clean.clip(-limit, limit)
        after: Chunk = clean
        if step.next_noise != 0.0:
            noise = (noisy - step.signal * clean) / step.noise
            after = step.next_signal * clean + step.next_noise * noise
        return after


def flight_noise(seed: int, steps: int) -> Tensor:
    """Return the initial noise [1, steps, 4] of a flight's solves: equal on every device."""
    return torch.randn(1, steps, ACTION_DIM, generator=torch.Generator().manual_seed(seed))


@lru_cache(maxsize=16)
def signal_power(schedule: NoiseSchedule) -> tuple[float, ...]:
    """Return a_t for every training timestep, falling from almost 1 to almost 0.

    Schedules of Nichol & Dhariwal 2021, section 3.2, and Ho's linear one scaled to their number.
    """
    power, powers, total = 1.0, [], schedule.num_train_timesteps
    for t in range(total):
        if schedule.betas == "linear":
            # 1e-4..0.02 is for 1000 steps; equal noise in fewer steps needs larger betas.
            beta = (1e-4 + (0.02 - 1e-4) * t / max(total - 1, 1)) * 1000 / total
        else:
            beta = 1 - cosine_power((t + 1) / total) / cosine_power(t / total)
        power *= 1 - min(beta, 0.999)
        powers.append(power)
    return tuple(powers)


def cosine_power(fraction: float) -> float:
    """Return the squared-cosine signal power after a share of the process."""
    return math.cos((fraction + 0.008) / 1.008 * math.pi / 2) ** 2


@lru_cache(maxsize=256)
def _ddim_steps(schedule: NoiseSchedule, count: int) -> tuple[DdimStep, ...]:
    power, total = signal_power(schedule), schedule.num_train_timesteps
    timesteps = [total * (count - i) // count - 1 for i in range(count)]
    return steps_at(timesteps, [math.sqrt(a) for a in power], [math.sqrt(1 - a) for a in power])


def steps_at(
    timesteps: Sequence[int], signal: Sequence[float], noise: Sequence[float]
) -> tuple[DdimStep, ...]:
    """Return the steps from each of these timesteps to the next, and from the last to x_0.

    ``signal`` and ``noise`` are the coefficients of every training timestep.
    """
    after = [*((signal[t], noise[t]) for t in timesteps[1:]), (1.0, 0.0)]
    return tuple(
        DdimStep(timestep=t, signal=signal[t], noise=noise[t], next_signal=s, next_noise=n)
        for t, (s, n) in zip(timesteps, after, strict=True)
    )


class SizeDims(NamedTuple):
    """Network dimensions of one size."""

    base_dim: int
    """Width of the feature, the tokens and the condition."""
    widths: tuple[int, ...]
    """Channels of the U-Net's levels."""


SIZE_DIMS: dict[Size, SizeDims] = {
    "small": SizeDims(256, (96, 160, 256)),
    "medium": SizeDims(384, (192, 320, 512)),
    "large": SizeDims(512, (320, 640, 960)),
}
"""Heads of about 3, 12 and 40 million parameters. On a CPU every diffusion step reads all weights
once: 100 Hz with 10 steps allows about 3 million weights on one core."""


class DiffusionHead(nn.Module):
    """Denoiser, noise schedule and initial noise.

    The prediction, a clean chunk, is the sum of a linear layer's output for the condition and the
    U-Net's output for the noisy chunk. The linear layer learns the mean chunk within minutes, and
    the U-Net learns the deviations from it, which are zero at the noisiest step. So a head steers
    in few steps and after little training.

    The initial noise is fixed for a flight: equal inputs then give equal sticks, and chunks do not
    jitter from sample to sample. It is not part of a checkpoint. Steps that the schedule does not
    have raise a ``PolicyError``.
    """

    def __init__(self, size: Size, contract: Contract, schedule: NoiseSchedule) -> None:
        super().__init__()
        dims = SIZE_DIMS[size]
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
        """Call the network: [B, horizon, 4], [B] int64, [B, C] -> the clean chunk."""
        film = self.unet.film_of_timestep(timestep) + self.unet.film_of_condition(condition)
        prediction: Tensor = self.unet(noisy, film)
        return prediction + self.read(condition)

    def read(self, condition: Tensor) -> Tensor:
        """Return the mean chunk [B, horizon, 4] for a condition [B, C]."""
        chunk: Tensor = self.direct(condition)
        return chunk.reshape(condition.shape[0], -1, ACTION_DIM)

    def sample(self, condition: Tensor, num_diffusion_steps: int) -> Tensor:
        """Sample a chunk [B, horizon, 4] in [-1, 1] for a condition [B, C]."""
        sample = self.initial_noise.expand(condition.shape[0], -1, -1)
        steps = self.schedule.ddim_steps(num_diffusion_steps)
        # Selected on the device: a CUDA graph capture allows no copy from the host.
        timesteps = torch.stack([self._timesteps[step.timestep] for step in steps])
        # Both parts of FiLM are outside the loop; one product serves all timesteps.
        film_of_step = self.unet.film_of_timestep(timesteps).unsqueeze(1)
        film_of_condition = self.unet.film_of_condition(condition)
        read = self.read(condition)
        for index, step in enumerate(steps):
            prediction = self.unet(sample, film_of_step[index] + film_of_condition) + read
            sample = self.schedule.ddim_update(step, sample, prediction)
        return sample
