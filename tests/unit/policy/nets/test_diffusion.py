import math
from functools import partial
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from policy.errors import PolicyError
from policy.nets.diffusion import NoiseSchedule, ddim_solve, signal_power


def solve(schedule: NoiseSchedule, count: int, denoise: object, noise: Tensor) -> Tensor:
    """``denoise(signal, noise_scale, x)`` with the coefficients of the step."""
    steps = schedule.ddim_steps(count)
    return ddim_solve(
        schedule,
        steps,
        lambda index, x: denoise(steps[index].signal, steps[index].noise, x),  # type: ignore[operator]
        noise,
    )


def test_schedules_by_hand() -> None:
    power = signal_power(NoiseSchedule())
    at_zero = math.cos(0.008 / 1.008 * math.pi / 2) ** 2
    for t in (0, 9, 49, 98):  # the last beta is capped at 0.999
        expected = math.cos(((t + 1) / 100 + 0.008) / 1.008 * math.pi / 2) ** 2 / at_zero
        assert power[t] == pytest.approx(expected, rel=1e-9)
    assert power[99] == pytest.approx(0.001 * power[98])
    power = signal_power(NoiseSchedule(betas="linear"))
    assert power[1] == pytest.approx((1 - 1e-3) * (1 - (1e-3 + 0.199 / 99)))
    assert power[99] < 1e-4


def test_steps_start_at_pure_noise_and_end_clean() -> None:
    for count in range(1, 101):
        steps = NoiseSchedule().ddim_steps(count)
        timesteps = [step.timestep for step in steps]
        assert len(timesteps) == count
        assert timesteps[0] == 99
        assert timesteps == sorted(set(timesteps), reverse=True)
        assert (steps[-1].next_signal, steps[-1].next_noise) == (1.0, 0.0)
        for step, following in pairwise(steps):
            assert (step.next_signal, step.next_noise) == (following.signal, following.noise)


DEVIATION = 0.1


def gaussian_posterior_mean(signal: float, noise_scale: float, x: Tensor) -> Tensor:
    """E[x_0 | x_t] for x_0 ~ N(0, DEVIATION^2): the best a net can do."""
    variance = DEVIATION**2
    return signal * variance / (signal**2 * variance + noise_scale**2) * x


def gaussian_flow(schedule: NoiseSchedule, noise: Tensor) -> Tensor:
    """Closed-form end of the probability flow: it keeps x_t over its marginal deviation."""
    power = signal_power(schedule)[-1]
    return noise * DEVIATION / math.sqrt(power * DEVIATION**2 + 1 - power)


def gaussian_error(schedule: NoiseSchedule, count: int) -> float:
    """Largest error of a solve with the analytic score, relative to the largest exact value."""
    noise = torch.linspace(-3, 3, 13, dtype=torch.float64)
    exact = gaussian_flow(schedule, noise)

    def denoise(signal: float, noise_scale: float, x: Tensor) -> Tensor:
        clean = gaussian_posterior_mean(signal, noise_scale, x)
        return clean if schedule.prediction == "sample" else (x - signal * clean) / noise_scale

    return float((solve(schedule, count, denoise, noise) - exact).abs().max() / exact.abs().max())


@pytest.mark.parametrize("prediction", ["epsilon", "sample"])
@pytest.mark.parametrize("betas", ["squared_cosine", "linear"])
def test_gaussian_data_converges_to_the_probability_flow(betas, prediction):
    schedule = NoiseSchedule(betas=betas, prediction=prediction)
    errors = [gaussian_error(schedule, count) for count in (5, 10, 25, 50, 100)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < 0.15


@pytest.mark.parametrize(
    ("call", "told"),
    [
        *((partial(NoiseSchedule().ddim_steps, n), r"1\.\.100") for n in (0, 101, 10.0, True)),
        *((partial(NoiseSchedule, num_train_timesteps=n), "1..1000") for n in (0, 1001)),
        (partial(NoiseSchedule, betas="quadratic"), "squared_cosine"),
        (partial(NoiseSchedule, prediction="velocity"), "epsilon"),
    ],
)
def test_invalid_schedules_and_step_counts_are_refused(call, told):
    with pytest.raises(PolicyError, match=told):
        call()
