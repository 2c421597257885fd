"""A diffusion solve in parts of a few steps each, for engines that unroll their steps."""

from collections.abc import Callable
from typing import Any

import numpy as np

from policy.contract import FloatArray

Segment = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""(encoded image, state, history, noisy chunk [1, horizon, 4]) -> less noisy chunk."""


def sample_in_segments(
    noise: FloatArray, segment: Callable[[int, int], Segment], steps: int, at_once: int
) -> Callable[[FloatArray, FloatArray, FloatArray], FloatArray]:
    """(encoded image, state, history) -> chunk [1, horizon, 4], by ``steps`` from ``noise`` on.

    ``segment`` makes the function that runs (first, at most ``at_once``) steps.
    """
    segments = [segment(first, min(at_once, steps - first)) for first in range(0, steps, at_once)]

    def sample(encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        noisy = noise
        for run in segments:
            noisy = run(encoded, state, history, noisy)
        return noisy

    return sample


def to_numpy(array: Any) -> FloatArray:
    """A float32 copy of an array of any kind, on any device."""
    return np.array(array.cpu().numpy() if hasattr(array, "cpu") else array, np.float32)
