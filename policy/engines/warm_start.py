"""Warm start: the last chunk, moved to now, is a guess that a few denoising steps improve.

Training-free, after Falcon (Chen et al. 2025, arXiv 2503.00339) and RTI-DP (arXiv 2508.05396). A
guess that is only ever improved can settle beside what a full solve finds ("execution stall", STEP,
arXiv 2602.08245), so every ``FULL_EVERY_S`` the chunk is sampled from noise again.
"""

from collections.abc import Callable

import numpy as np

from policy.contract import FloatArray

FULL_EVERY_S = 1.0
"""Time between full solves, in seconds of the states that the chunks belong to."""

Sample = Callable[[FloatArray, FloatArray, FloatArray], FloatArray]
"""(encoded image, state, history) -> chunk [1, horizon, 4], from noise."""
Refine = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""(encoded image, state, history, guess [1, horizon, 4]) -> chunk [1, horizon, 4]."""


def moved_chunk(chunk: FloatArray, periods: float) -> FloatArray:
    """What a chunk says ``periods`` of its actions later, its last action held.

    Args:
        chunk: [1, horizon, 4].
        periods: 0 or more; linear between two actions.
    """
    last = chunk.shape[1] - 1
    at = np.minimum(np.arange(last + 1) + periods, last)
    low = at.astype(np.intp)
    share = (at - low).astype(np.float32)[:, None]
    moved: FloatArray = chunk[:, low] * (1 - share) + chunk[:, np.minimum(low + 1, last)] * share
    return moved


class WarmStart:
    """``Executable.act``; keeps the last chunk. The same calls give the same chunks."""

    def __init__(self, sample: Sample, refine: Refine, *, chunk_dt_s: float) -> None:
        self._sample = sample
        self._refine = refine
        self._chunk_dt_s = chunk_dt_s
        self._last: FloatArray | None = None
        self._since_full_s = 0.0

    def __call__(
        self,
        encoded: FloatArray,
        state: FloatArray,
        history: FloatArray,
        elapsed_s: float | None,
    ) -> FloatArray:
        """A full solve when fresh, overdue or after time went backwards; else a refinement."""
        last, self._last = self._last, None
        self._since_full_s += elapsed_s or 0.0
        if last is None or elapsed_s is None or elapsed_s < 0 or self._since_full_s >= FULL_EVERY_S:
            self._since_full_s = 0.0
            chunk = self._sample(encoded, state, history)
        else:
            guess = moved_chunk(last, elapsed_s / self._chunk_dt_s)
            chunk = self._refine(encoded, state, history, guess)
        self._last = chunk
        return chunk
