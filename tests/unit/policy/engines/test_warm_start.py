from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from policy.contract import Contract, FloatArray
from policy.engines.executable import ExecutionSettings, make_numpy_executable
from policy.engines.torch_eager import make_torch_executable
from policy.engines.warm_start import FULL_EVERY_S, Solve, WarmStart, shift_chunk
from policy.errors import PolicyError
from policy.nets.toge import Toge
from policy.protocol import Executable

Fly = Callable[[Executable, float | None], FloatArray]
CHUNK = np.random.default_rng(0).uniform(-1, 1, (1, 16, 4)).astype(np.float32)


@given(st.floats(0, 40))
def test_a_moved_chunk_is_the_chunk_read_later(periods: float) -> None:
    at = np.arange(16) + periods
    expected = np.stack([np.interp(at, np.arange(16), CHUNK[0, :, k]) for k in range(4)], axis=1)
    np.testing.assert_allclose(shift_chunk(CHUNK, periods)[0], expected, atol=1e-5)


def test_a_chunk_moved_by_nothing_is_itself() -> None:
    np.testing.assert_array_equal(shift_chunk(CHUNK, 0.0), CHUNK)
    np.testing.assert_array_equal(shift_chunk(CHUNK, 1e9), np.repeat(CHUNK[:, -1:], 16, axis=1))


TICK_S = 1 / 256
"""Exact in binary, so that seconds end on a tick."""
CONTRACT = Contract(feature_dim=1, image_height=16, image_width=16, arrays="numpy")
FEATURE = np.zeros((1, 1), np.float32)
STATE = np.eye(1, 13, 3, dtype=np.float32)
HISTORY = np.zeros((1, 4, 4), np.float32)


class CountingPolicy:
    """A chunk is the number of denoising steps that went into it; all steps are counted."""

    contract = CONTRACT
    initial_noise = np.zeros((1, 16, 4), np.float32)

    def __init__(self) -> None:
        self.steps = 0
        self.seen: list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]] = []

    def predict(self, *_: Any) -> FloatArray:
        raise AssertionError("a warm start takes another way")

    predict_fast = predict

    def encode_visual(self, image: FloatArray) -> FloatArray:
        return FEATURE

    def noise_shares(self, num_diffusion_steps: int, first: int) -> tuple[float, float]:
        return 1.0, 0.0

    def denoise_fast(
        self, f: FloatArray, s: FloatArray, h: FloatArray, noisy: FloatArray, *span: int
    ) -> FloatArray:
        num_diffusion_steps, first, count = span
        assert 0 <= first < first + count <= num_diffusion_steps
        self.steps += count
        self.seen.append((f, s, h, noisy))
        return noisy + np.float32(count)


class Flight:
    """Steps that each tick took, and the steps that went into the chunk it flew."""

    def __init__(self, *elapsed_s: float | None, head_steps: int) -> None:
        policy = CountingPolicy()
        act = make_numpy_executable(
            policy, ExecutionSettings(name="count", head_steps=head_steps)
        ).act
        self.took: list[int] = []
        self.chunks: list[int] = []
        for since_s in elapsed_s:
            before = policy.steps
            self.chunks.append(int(act(FEATURE, STATE, HISTORY, since_s)[0, 0, 0]))
            self.took.append(policy.steps - before)


SEGMENTS = {1: [1] * 10, 2: [2] * 5, 3: [1, 3, 3, 3], 4: [2, 4, 4], 10: [10]}


@pytest.mark.parametrize("head_steps", SEGMENTS)
def test_no_tick_but_the_first_takes_more_than_twice_the_steps(head_steps: int) -> None:
    flight = Flight(None, *[TICK_S] * 1000, head_steps=head_steps)
    beside = SEGMENTS[head_steps]
    second = [head_steps + extra for extra in beside] + [head_steps] * (256 - len(beside))
    assert flight.took == [10, *[head_steps] * 255, *(second * 3)[:745]]
    assert max(flight.took[1:]) <= 2 * head_steps


@pytest.mark.parametrize("head_steps", SEGMENTS)
def test_every_second_the_chunk_starts_from_a_full_solve_again(head_steps: int) -> None:
    flight = Flight(None, *[TICK_S] * 1000, head_steps=head_steps)
    after = 256 + len(SEGMENTS[head_steps])
    for tick, steps in enumerate(flight.chunks):
        since = tick if tick < after else (tick - after) % 256 + 1
        assert steps == 10 + head_steps * since


def whole_solves(*elapsed_s: float | None) -> list[int]:
    took = Flight(*elapsed_s, head_steps=2).took
    return [tick for tick, steps in enumerate(took) if steps == 10]


@pytest.mark.parametrize(
    ("elapsed_s", "expected"),
    [
        ([None, 0.01, 0.0], [0]),
        ([None, 0.01, None, 0.01], [0, 2]),
        ([None, -0.01, 0.01], [0, 1]),
        ([None, FULL_EVERY_S, 0.01], [0, 1]),  # what was the plan then is no guess now
        ([None, *[0.4 * FULL_EVERY_S] * 9], [0, 8]),  # nor is a solve spread over so long
    ],
)
def test_when_the_solve_is_whole(elapsed_s: list[float | None], expected: list[int]) -> None:
    assert whole_solves(*elapsed_s) == expected


def test_without_a_chunk_the_solve_is_whole_whatever_the_caller_says() -> None:
    solve, _ = recorded()
    chunk = WarmStart(solve, chunk_dt_s=0.05)(FEATURE, STATE, HISTORY, 0.01)
    np.testing.assert_array_equal(chunk, CHUNK + 1 + 1)


@pytest.mark.parametrize("interruption_s", [None, -0.5, FULL_EVERY_S])
def test_a_release_drops_the_spread_solve(interruption_s: float | None) -> None:
    before = [None, *[TICK_S] * 257]  # the second segment was the last that ran
    flight = Flight(*before, interruption_s, *[TICK_S] * 300, head_steps=2)
    assert flight.took[255:259] == [2, 4, 4, 10]
    assert flight.took[259:] == [*[2] * 255, *[4] * 5, *[2] * 40]
    assert flight.chunks[258:] == [*range(10, 532, 2), *range(12, 92, 2)]


Seen = list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]


def recorded() -> tuple[Solve, Seen]:
    """Two segments that add 1 to what they start with, ``CHUNK`` at first, and what they took."""
    seen: Seen = []

    def segment(e: FloatArray, s: FloatArray, h: FloatArray, noisy: FloatArray) -> FloatArray:
        seen.append((e.copy(), s.copy(), h.copy(), noisy.copy()))
        return noisy + 1

    return Solve(noise=CHUNK, segments=(segment,) * 2, guess_share=0.5, noise_share=0.25), seen


def test_a_guess_is_the_last_chunk_moved_by_the_elapsed_time_and_noised() -> None:
    solve, seen = recorded()
    warm = WarmStart(solve, chunk_dt_s=0.05)
    warm(FEATURE, STATE, HISTORY, None)
    warm(FEATURE, STATE, HISTORY, 0.02)
    np.testing.assert_array_equal(seen[-1][3], 0.5 * shift_chunk(CHUNK + 1 + 1, 0.4) + 0.25 * CHUNK)


def test_a_spread_solve_is_that_of_the_tick_where_it_began() -> None:
    solve, seen = recorded()
    warm = WarmStart(solve, chunk_dt_s=0.25)
    now = [np.zeros((1, 1), np.float32) for _ in range(3)]
    for tick, elapsed_s in enumerate([None, 0.5, 0.5, 0.125, 0.25]):
        for array in now:
            array[:] = tick  # the caller's own, written to again
        warm(now[0], now[1], now[2], elapsed_s)
    # Whole, warm, then warm and a segment twice, then warm.
    ticks = [[int(array[0, 0]) for array in inputs[:3]] for inputs in seen]
    assert ticks == [[tick] * 3 for tick in (0, 0, 1, 2, 2, 3, 2, 4)]
    np.testing.assert_array_equal(seen[4][3], CHUNK)
    np.testing.assert_array_equal(seen[6][3], CHUNK + 1)
    guess = shift_chunk(CHUNK + 1 + 1, (0.125 + 0.25) / 0.25)
    np.testing.assert_array_equal(seen[7][3], 0.5 * guess + 0.25 * CHUNK)


def test_a_solve_that_fails_leaves_no_chunk_behind() -> None:
    calls = 0

    def segment(*inputs: FloatArray) -> FloatArray:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise RuntimeError("boom")
        return inputs[-1]

    solve = Solve(noise=CHUNK, segments=(segment,), guess_share=1.0, noise_share=0.5)
    warm = WarmStart(solve, chunk_dt_s=0.05)
    warm(FEATURE, STATE, HISTORY, None)
    with pytest.raises(RuntimeError, match="boom"):
        warm(FEATURE, STATE, HISTORY, 0.01)
    np.testing.assert_array_equal(warm(FEATURE, STATE, HISTORY, 0.01), CHUNK)


@pytest.mark.parametrize("head_steps", [2, 3])
@torch.inference_mode()
def test_on_torch_the_spread_solve_is_the_whole_one_bit_for_bit(
    trained_toge: Toge, head_steps: int
) -> None:
    random = np.random.default_rng(1)
    feature = random.normal(size=(1, 256)).astype(np.float32)
    level = np.eye(1, trained_toge.contract.state_dim, 3, dtype=np.float32)
    states = [level + np.float32(0.01 * tick) for tick in range(9)]
    warm = make_torch_executable(trained_toge, ExecutionSettings(name="t", head_steps=head_steps))
    full = make_torch_executable(trained_toge, ExecutionSettings(name="t"))
    segments = len(SEGMENTS[head_steps])
    elapsed_s = [None, 0.5, 0.5, *[0.01] * segments]
    for state, since_s in zip(states, elapsed_s, strict=False):
        chunk = warm.act(feature, state, HISTORY, since_s)
    began, ended = 2, 2 + segments
    guess = shift_chunk(
        full.act(feature, states[began], HISTORY, None), sum([0.01] * segments) / 0.05
    )
    signal, noise = trained_toge.noise_shares(10, 10 - head_steps)
    noisy = signal * torch.tensor(guess) + noise * trained_toge.initial_noise
    inputs = (torch.tensor(array) for array in (feature, states[ended], HISTORY))
    expected = trained_toge.denoise_fast(*inputs, noisy, 10, 10 - head_steps, head_steps)
    np.testing.assert_array_equal(chunk, expected.numpy())


@pytest.fixture(scope="module")
def full(trained_toge: Toge, fly: Fly) -> FloatArray:
    return fly(make_torch_executable(trained_toge, ExecutionSettings(name="toge")), None)


def test_a_warm_start_of_all_steps_is_the_full_solve(
    trained_toge: Toge, fly: Fly, full: FloatArray
) -> None:
    warm = fly(
        make_torch_executable(trained_toge, ExecutionSettings(name="toge", head_steps=10)), 0.02
    )
    np.testing.assert_allclose(warm, full, atol=1e-3)


def test_a_warm_start_follows_the_full_solve_the_nearer_the_more_steps_it_takes(
    trained_toge: Toge, fly: Fly, full: FloatArray
) -> None:
    """How near a short one comes depends on the weights: those that ship hold on to the last chunk,
    and fly without one."""
    distances = []
    for head_steps in (1, 3, 5):
        settings = ExecutionSettings(name="toge", head_steps=head_steps)
        distance = np.abs(fly(make_torch_executable(trained_toge, settings), 0.02) - full)
        assert distance.max() > 0.001
        distances.append(distance.mean() / np.abs(full).mean())
    assert distances[0] > distances[1] > distances[2]
    assert distances[1] < 0.75
    assert distances[2] < 0.25


def test_the_same_flight_gives_the_same_sticks(trained_toge: Toge, fly: Fly) -> None:
    settings = ExecutionSettings(name="toge", head_steps=2)
    first, second = (fly(make_torch_executable(trained_toge, settings), 0.02) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("head_steps", [0, 11])
def test_refuses_steps_that_the_solve_does_not_have(small_toge: Toge, head_steps: int) -> None:
    with pytest.raises(PolicyError, match=r"head_steps must be in 1\.\.10"):
        make_torch_executable(small_toge, ExecutionSettings(name="toge", head_steps=head_steps))
