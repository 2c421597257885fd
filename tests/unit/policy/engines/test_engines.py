from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner
from policy.engines.torch_engines import FasterThreads, make_torch_runner, torch_threads
from policy.errors import PolicyError
from policy.nets.toge import Toge
from policy.preprocess import image_to_input

RGB = np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8)
STATE = np.eye(1, 13, 3, dtype=np.float32)
HISTORY = np.zeros((1, 4, 4), np.float32)


def frozen(array: np.ndarray) -> np.ndarray:
    array = array.copy()
    array.flags.writeable = False
    return array


@pytest.mark.parametrize("steps", [1, 10])
def test_two_rates_in_torch_match_the_net_called_directly(small_toge: Toge, steps: int) -> None:
    settings = ExecutionSettings(name="toge", num_diffusion_steps=steps)
    runner = make_torch_runner(small_toge, settings)
    assert (runner.engine, runner.dual_rate) == ("torch", True)
    feature = runner.encode(RGB)
    chunk = runner.act(frozen(feature), frozen(STATE), frozen(HISTORY))
    image = torch.tensor(image_to_input(RGB, small_toge.contract))
    with torch.inference_mode():
        expected = small_toge.predict(image, torch.tensor(STATE), torch.tensor(HISTORY), steps)
    assert feature.dtype == chunk.dtype == np.float32
    np.testing.assert_array_equal(chunk, expected.numpy())


class Fake:
    """A dual-rate numpy policy whose parts can be replaced."""

    def __init__(self, **parts: Callable[..., Any]) -> None:
        self.contract = Contract(
            image_height=16, image_width=16, feature_dim=2, horizon=4, arrays="numpy"
        )
        self._parts = parts

    def encode_visual(self, image: np.ndarray) -> Any:
        return self._parts.get("encode", lambda _: np.zeros((1, 2)))(image)

    def predict_fast(self, feature: Any, state: Any, action_history: Any, steps: int) -> Any:
        return self._parts.get("act", lambda *_: np.zeros((1, 4, 4)))(feature, state)

    def predict(self, image: Any, state: Any, action_history: Any, steps: int) -> Any:
        return self.predict_fast(image, state, action_history, steps)


def raises(error: Exception) -> Callable[..., Any]:
    def call(*_: Any) -> Any:
        raise error

    return call


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"encode": lambda _: np.zeros((1, 3))}, r"encode_visual must be \[1, 2\]"),
        ({"encode": lambda _: np.full((1, 2), np.nan)}, "encode_visual holds NaN"),
        ({"encode": lambda _: [0.0, 0.0]}, "returned list"),
        ({"act": lambda *_: np.zeros((4, 4))}, r"the chunk must be \[1, 4, 4\]"),
        ({"act": lambda *_: np.full((1, 4, 4), np.inf)}, "the chunk holds NaN or infinity"),
        ({"act": raises(RuntimeError("boom"))}, r"RuntimeError: boom \(.*test_engines.py:\d+\)"),
        ({"act": raises(KeyError("x"))}, r"image \[1, 3, 16, 16\], state \[1, 13\]"),
    ],
)
def test_a_policy_that_breaks_its_contract_never_flies(parts, message):
    with pytest.raises(PolicyError, match=message):
        make_numpy_runner(Fake(**parts), ExecutionSettings(name="fake"))


def test_torch_policies_must_return_tensors() -> None:
    policy = Fake()
    policy.contract = replace(policy.contract, arrays="torch")
    with pytest.raises(PolicyError, match="returned ndarray; its contract says torch"):
        make_torch_runner(policy, ExecutionSettings(name="fake"))


def test_arrays_are_copied_in_and_out() -> None:
    """A careless policy writes to what it is given, and to what it has returned."""
    kept = np.zeros((1, 2), np.float32)

    def encode(image: np.ndarray) -> np.ndarray:
        image *= 0.5
        kept[:] += 1
        return kept

    def act(feature: np.ndarray, state: np.ndarray) -> np.ndarray:
        feature += 1
        state[:, :3] /= 5
        return np.zeros((1, 4, 4), np.float32)

    runner = make_numpy_runner(Fake(encode=encode, act=act), ExecutionSettings(name="careless"))
    feature = runner.encode(RGB)
    feature.setflags(write=False)  # as the vision loop publishes it
    before, state = feature.copy(), frozen(np.ones((1, 13), np.float32))
    runner.encode(RGB)
    runner.act(feature, state, HISTORY)
    np.testing.assert_array_equal(feature, before)
    assert (state == 1).all()


@pytest.mark.parametrize(("all_s", "one_s", "kept"), [(1.0, 1.5, 3), (9.0, 1.5, 1)])
def test_steps_use_the_number_of_threads_that_took_less_time(all_s, one_s, kept) -> None:
    now_s, used = [0.0], []
    with torch_threads(3):
        threads = FasterThreads(lambda: now_s[0])
        for _ in range(20):
            with threads.step():
                used.append(torch.get_num_threads())
                now_s[0] += all_s if used[-1] == 3 else one_s
        assert used == [3, 1, 3, 1] + [kept] * 16
        assert torch.get_num_threads() == kept
