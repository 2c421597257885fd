"""PolicyRunners for simulated flights that hold the same sticks for each chunk."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from policy.contract import Contract, FloatArray
from policy.protocol import PolicyRunner

CONTRACT = Contract(feature_dim=1, arrays="numpy", image_height=32, image_width=32)


def steady(sticks: Callable[[], tuple[float, float, float, float]]) -> PolicyRunner:
    """Return a runner that calls ``sticks`` at every action and holds the result for the chunk."""

    def act(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        chunk = np.empty((1, CONTRACT.horizon, 4), np.float32)
        chunk[:] = sticks()
        return chunk

    return PolicyRunner(
        contract=CONTRACT,
        name="test",
        engine="numpy",
        dual_rate=True,
        encode=lambda rgb, camera=0: np.full((1, 1), rgb.mean(), np.float32),
        act=act,
    )


def single_rate(runner: PolicyRunner) -> PolicyRunner:
    return replace(runner, dual_rate=False)
