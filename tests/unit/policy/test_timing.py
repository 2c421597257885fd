"""Durations of a policy, by a clock that only the policy moves."""

from dataclasses import replace

import numpy as np
import pytest

from policy.contract import Contract, FloatArray
from policy.errors import NoChunkError
from policy.loading.request import SolveTimes, measure_times
from policy.protocol import PolicyRunner


class Timed:
    """A policy whose calls take the given times, one after the other."""

    def __init__(self, act_s: list[float], contract: Contract) -> None:
        self.now_s = 0.0
        self._act_s = act_s
        self.acts = 0
        self.runner = PolicyRunner(
            contract=contract,
            name="test",
            engine="numpy",
            dual_rate=True,
            encode=self._encode,
            act=self._act,
        )

    def _encode(self, rgb: object, camera: int = 0, /) -> FloatArray:
        self.now_s += 0.01
        return np.zeros((1, 1), np.float32)

    def _act(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        self.now_s += self._act_s[min(self.acts, len(self._act_s) - 1)]
        self.acts += 1
        return np.zeros((1, 16, 4), np.float32)


ONE = Contract(feature_dim=1, arrays="numpy")


def test_one_slow_repetition_does_not_make_a_policy_slow() -> None:
    timed = Timed([0.004, 0.2, 0.004, 0.005, 0.006], ONE)
    times = measure_times(timed.runner, lambda: timed.now_s)
    assert times == SolveTimes(encode_s=pytest.approx(0.01), act_s=pytest.approx(0.005))


def test_a_slow_policy_and_a_clock_that_stands_still_are_asked_once() -> None:
    timed = Timed([0.5], ONE)
    assert measure_times(timed.runner, lambda: timed.now_s) == SolveTimes(
        encode_s=pytest.approx(0.01), act_s=0.5
    )
    assert timed.acts == 1
    assert measure_times(timed.runner, lambda: 7.0) == SolveTimes(encode_s=0.0, act_s=0.0)
    assert timed.acts == 2


def test_without_a_chunk_there_is_no_time_of_one() -> None:
    def act(*inputs: object) -> FloatArray:
        raise NoChunkError("the server is not there yet")

    runner = replace(Timed([], ONE).runner, act=act)
    assert measure_times(runner, lambda: 0.0) is None
