"""Policies that compute in numpy are called as they are."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from policy.contract import Executable, FloatArray, SingleRatePolicy
from policy.engines.executable import ArrayFunction, ExecutionSettings, Shape, make_executable
from policy.errors import PolicyError

NAME = "numpy"


def make_numpy_executable(policy: SingleRatePolicy, settings: ExecutionSettings) -> Executable:
    """Wrap a numpy policy for the loops; tried once.

    Raises:
        PolicyError: no fast path where one was asked for, or it failed on a dummy sample.
    """

    def compile_(method: Callable[..., Any], _shapes: Sequence[Shape]) -> ArrayFunction:
        def run(*arrays: FloatArray) -> FloatArray:
            # Copies in and out: what is published is read-only, and what is returned may be a
            # buffer that the policy writes to again.
            result = method(*(array.copy() for array in arrays))
            if not isinstance(result, np.ndarray):
                raise PolicyError(
                    f"{settings.name} returned {type(result).__name__}; its contract says numpy "
                    "arrays"
                )
            return np.array(result, np.float32)

        return run

    return make_executable(policy, policy, compile_, compile_, engine=NAME, settings=settings)
