import math
from functools import partial
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from policy.errors import PolicyError
from policy.nets.diffusion import NoiseSchedule, signal_power

SCHEDULES = st.builds(
    NoiseSchedule,
    num_train_timesteps=st.integers(1, 200),
    betas=st.sampled_from(["squared_cosine", "linear"]),
    prediction=st.sampled_from(["sample", "epsilon"]),
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


@given(schedule=SCHEDULES, data=st.data())
def test_any_net_gives_actions_in_range(schedule: NoiseSchedule, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, schedule.num_train_timesteps))
    scale = data.draw(st.floats(-1e6, 1e6))
    result = torch.linspace(-4, 4, 9)
    for index, step in enumerate(schedule.ddim_steps(count)):
        result = schedule.ddim_update(step, result, scale * (result + index).cos())
    assert bool(torch.isfinite(result).all())
    assert float(result.abs().max()) <= 1.0


@given(schedule=SCHEDULES, data=st.data())
def test_add_noise_is_undone_by_one_perfect_step(schedule, data):
    count = data.draw(st.integers(1, schedule.num_train_timesteps))
    step = data.draw(st.sampled_from(schedule.ddim_steps(count)))
    clean = torch.linspace(-1, 1, 9, dtype=torch.float64).reshape(1, 9)
    noise = torch.linspace(2, -2, 9, dtype=torch.float64).reshape(1, 9)
    noisy = schedule.add_noise(clean, noise, torch.tensor([step.timestep]))
    output = clean if schedule.prediction == "sample" else noise
    expected = step.next_signal * clean + step.next_noise * noise
    torch.testing.assert_close(
        schedule.ddim_update(step, noisy, output), expected, atol=1e-6, rtol=0
    )
