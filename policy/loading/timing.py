"""How long a policy takes on this computer, measured before it flies."""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median

import numpy as np

from policy.contract import ACTION_DIM
from policy.engines.runner import encode_all, level_state
from policy.errors import NoChunkError
from policy.preprocess import dummy_images
from policy.protocol import PolicyRunner

REPETITIONS = 5
MOST_S = 0.5
"""No further repetition after so much time: a slow policy is known to be slow after one."""


@dataclass(frozen=True, kw_only=True)
class SolveTimes:
    """Medians, by the clock that they were measured with: zero on one that stands still."""

    encode_s: float
    """One image of each camera; without a fast path that is resizing alone."""
    act_s: float
    """One chunk."""


def measure_times(runner: PolicyRunner, now_s: Callable[[], float]) -> SolveTimes | None:
    """Time a policy that was tried before; None if it had no chunk for the dummy sample.

    By a clock that stands still, as in simulations, it is asked only once.
    """
    contract = runner.contract
    images, state = dummy_images(contract), level_state(contract)
    history = np.zeros((1, contract.history_len, ACTION_DIM), np.float32)
    encode_s: list[float] = []
    act_s: list[float] = []
    begun_s = now_s()
    while len(act_s) < REPETITIONS and (not act_s or 0 < now_s() - begun_s < MOST_S):
        before_s = now_s()
        encoded = encode_all(runner, images)
        encoded_s = now_s()
        try:
            runner.act(encoded, state, history)
        except NoChunkError:
            return None
        encode_s.append((encoded_s - before_s) / contract.observation_steps)
        act_s.append(now_s() - encoded_s)
    return SolveTimes(encode_s=median(encode_s), act_s=median(act_s))
