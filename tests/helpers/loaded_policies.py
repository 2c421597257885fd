"""A policy as a flight loads it, and one call of it."""

from typing import Any

import numpy as np

from policy.contract import FloatArray
from policy.engines.choose import chunks_of_samples, make_parity_samples, parity_failure
from policy.engines.runner import dummy_sample, encode_all
from policy.loading.load import load_policy
from policy.loading.request import LoadedPolicy, PolicyRequest
from policy.protocol import PolicyRunner


def load(spec: str, **flags: Any) -> LoadedPolicy:
    """Load a policy, timed by a clock that stands still."""
    return load_policy(PolicyRequest(spec=spec, **flags), now_s=lambda: 0.0)


def act(runner: PolicyRunner, *, vx_mps: float = 0.0, level: int = 90) -> FloatArray:
    """Return a chunk [horizon, 4], for a level vehicle with a velocity and evenly grey images."""
    images, state, history = dummy_sample(runner.contract)
    state[..., 0] = vx_mps
    return runner.act(encode_all(runner, np.full_like(images, level)), state, history)[0]


def require_same(a: PolicyRunner, b: PolicyRunner) -> None:
    """Fail if two policies do not pass the parity check of engines."""
    samples = make_parity_samples(a.contract)
    assert parity_failure(chunks_of_samples(a, samples), chunks_of_samples(b, samples)) is None
