from pathlib import Path

import numpy as np
import pytest

from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner
from policy.errors import PolicyError, user_code


@pytest.mark.parametrize("error", [AssertionError("no"), OSError("no"), SystemExit("no")])
def test_whatever_is_raised_becomes_one_message_with_its_place(error: BaseException) -> None:
    with (
        pytest.raises(PolicyError, match=rf"flying: {type(error).__name__}: no \(.*:\d+\)") as info,
        user_code("flying"),
    ):
        raise error
    assert Path(__file__).name in str(info.value)
    assert info.value.__cause__ is error


def test_what_is_clear_already_passes() -> None:
    with pytest.raises(PolicyError, match=r"^clear$"), user_code("flying"):
        raise PolicyError("clear")


class Careless:
    """Writes to what it is given, and returns what it writes to again."""

    contract = Contract(arrays="numpy", feature_dim=2)

    def __init__(self) -> None:
        self._feature = np.zeros((1, 2), np.float32)

    def encode_visual(self, image: np.ndarray) -> np.ndarray:
        image *= 0.5
        self._feature += 1
        return self._feature

    def predict_fast(
        self, feature: np.ndarray, state: np.ndarray, history: np.ndarray, steps: int
    ) -> np.ndarray:
        feature += 1
        state[:, :3] /= 5
        return np.zeros((1, 16, 4), np.float32)

    predict = predict_fast


def test_a_careless_policy_harms_nobody() -> None:
    runner = make_numpy_runner(Careless(), ExecutionSettings(name="careless"))
    first = runner.encode(np.zeros((8, 8, 3), np.uint8))
    first.setflags(write=False)  # as the vision loop publishes it
    before = first.copy()
    runner.encode(np.zeros((8, 8, 3), np.uint8))
    state = np.ones((1, 13), np.float32)
    state.setflags(write=False)
    runner.act(first, state, np.zeros((1, 4, 4), np.float32))
    assert (first == before).all()
    assert (state == 1).all()
