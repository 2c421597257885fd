from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from policy.contract import Executable, FloatArray, PolicyError
from policy.engines.executable import Settings
from policy.engines.torch_eager import make_torch_executable
from policy.engines.warm_start import FULL_EVERY_S, WarmStart, moved_chunk
from policy.toge import Toge

Fly = Callable[[Executable, float | None], FloatArray]
CHUNK = np.random.default_rng(0).uniform(-1, 1, (1, 16, 4)).astype(np.float32)
NOTHING = np.zeros((1, 1), np.float32)


@given(st.floats(0, 40))
def test_a_moved_chunk_is_the_chunk_read_later(periods: float) -> None:
    at = np.arange(16) + periods
    expected = np.stack([np.interp(at, np.arange(16), CHUNK[0, :, k]) for k in range(4)], axis=1)
    np.testing.assert_allclose(moved_chunk(CHUNK, periods)[0], expected, atol=1e-5)


def test_a_chunk_moved_by_nothing_is_itself() -> None:
    np.testing.assert_array_equal(moved_chunk(CHUNK, 0.0), CHUNK)
    np.testing.assert_array_equal(moved_chunk(CHUNK, 1e9), np.repeat(CHUNK[:, -1:], 16, axis=1))


class Solver:
    """Notes how each chunk was asked for."""

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.guesses: list[FloatArray] = []

    def sample(self, *_: FloatArray) -> FloatArray:
        self.calls.append("full")
        return CHUNK

    def refine(self, _e: FloatArray, _s: FloatArray, _h: FloatArray, g: FloatArray) -> FloatArray:
        self.calls.append("warm")
        self.guesses.append(g)
        return CHUNK


def calls(*elapsed_s: float | None) -> list[str]:
    solver = Solver()
    warm = WarmStart(solver.sample, solver.refine, chunk_dt_s=0.05)
    for since_s in elapsed_s:
        warm(NOTHING, NOTHING, NOTHING, since_s)
    return solver.calls


@pytest.mark.parametrize(
    ("elapsed_s", "expected"),
    [
        ([None, 0.01, 0.0], ["full", "warm", "warm"]),
        ([0.01], ["full"]),  # there is no chunk yet, whatever the caller says
        ([None, 0.01, None, 0.01], ["full", "warm", "full", "warm"]),
        ([None, -0.01, 0.01], ["full", "full", "warm"]),
        ([None, FULL_EVERY_S, 0.01], ["full", "full", "warm"]),
        ([None, *[0.4 * FULL_EVERY_S] * 5], ["full", "warm", "warm"] * 2),
    ],
)
def test_when_the_solve_is_full(elapsed_s: list[float | None], expected: list[str]) -> None:
    assert calls(*elapsed_s) == expected


def test_the_guess_is_the_last_chunk_moved_by_the_elapsed_time() -> None:
    solver = Solver()
    warm = WarmStart(solver.sample, solver.refine, chunk_dt_s=0.05)
    warm(NOTHING, NOTHING, NOTHING, None)
    warm(NOTHING, NOTHING, NOTHING, 0.02)
    np.testing.assert_array_equal(solver.guesses[0], moved_chunk(CHUNK, 0.4))


def test_a_solve_that_fails_leaves_no_chunk_behind() -> None:
    solver = Solver()

    def fail(*_: FloatArray) -> FloatArray:
        raise RuntimeError("boom")

    warm = WarmStart(solver.sample, fail, chunk_dt_s=0.05)
    warm(NOTHING, NOTHING, NOTHING, None)
    with pytest.raises(RuntimeError, match="boom"):
        warm(NOTHING, NOTHING, NOTHING, 0.01)
    warm(NOTHING, NOTHING, NOTHING, 0.01)
    assert solver.calls == ["full", "full"]


# Furthest and mean distance from the full solve, in sticks: about twice what was measured.
BOUNDS = {1: (0.05, 0.01), 3: (0.03, 0.006), 10: (1e-3, 1e-4)}


@pytest.mark.parametrize("head_steps", BOUNDS)
def test_warm_chunks_stay_near_the_full_solve(
    trained_toge: Toge, fly: Fly, head_steps: int
) -> None:
    settings = Settings(name="toge", head_steps=head_steps)
    warm = fly(make_torch_executable(trained_toge, settings), 0.01)
    full = fly(make_torch_executable(trained_toge, Settings(name="toge")), None)
    distance = np.abs(warm - full)
    furthest, mean = BOUNDS[head_steps]
    assert distance.max() <= furthest
    assert distance.mean() <= mean
    if head_steps < 10:
        assert distance.max() > 0.001  # it does take the short way
        since_full = round(FULL_EVERY_S * 100)
        np.testing.assert_array_equal(warm[since_full], full[since_full])


def test_the_same_flight_gives_the_same_sticks(trained_toge: Toge, fly: Fly) -> None:
    settings = Settings(name="toge", head_steps=2)
    first, second = (fly(make_torch_executable(trained_toge, settings), 0.01) for _ in range(2))
    np.testing.assert_array_equal(first, second)


@pytest.mark.parametrize("head_steps", [0, 11])
def test_refuses_steps_that_the_solve_does_not_have(small_toge: Toge, head_steps: int) -> None:
    with pytest.raises(PolicyError, match=r"head_steps must be in 1\.\.10"):
        make_torch_executable(small_toge, Settings(name="toge", head_steps=head_steps))
