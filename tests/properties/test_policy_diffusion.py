import torch
from hypothesis import given
from hypothesis import strategies as st

from policy.nets.diffusion import NoiseSchedule, ddim_solve

SCHEDULES = st.builds(
    NoiseSchedule,
    num_train_timesteps=st.integers(1, 200),
    betas=st.sampled_from(["squared_cosine", "linear"]),
    prediction=st.sampled_from(["sample", "epsilon"]),
)


@given(schedule=SCHEDULES, data=st.data())
def test_any_net_gives_actions_in_range(schedule: NoiseSchedule, data: st.DataObject) -> None:
    count = data.draw(st.integers(1, schedule.num_train_timesteps))
    scale = data.draw(st.floats(-1e6, 1e6))
    noise = torch.linspace(-4, 4, 9)
    result = ddim_solve(
        schedule, schedule.ddim_steps(count), lambda i, x: scale * (x + i).cos(), noise
    )
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
