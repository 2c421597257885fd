"""Warm start: the last chunk, moved to now, is a guess that a few denoising steps improve.

Training-free, after Falcon (Chen et al. 2025, arXiv 2503.00339) and RTI-DP (arXiv 2508.05396). A
guess that is only ever improved can settle beside what a full solve finds ("execution stall", STEP,
arXiv 2602.08245), so every ``FULL_EVERY_S`` a chunk is sampled from noise again. That solve is
spread over ticks, a segment beside each warm-started one: no tick but one without a guess takes
more than twice the steps of a warm start.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from policy.contract import FloatArray
from policy.errors import PolicyError
from policy.protocol import NoiseModel

FULL_EVERY_S = 1.0
"""Time between the starts of full solves, and the age at which a guess is dropped; measured between
the states that the chunks belong to."""

Segment = Callable[[FloatArray, FloatArray, FloatArray, FloatArray], FloatArray]
"""(encoded image, state, history, noisy chunk [1, horizon, 4]) -> less noisy chunk."""


@dataclass(frozen=True, kw_only=True)
class Solve:
    """An engine's full solve, in segments of a warm start's steps, and how a guess enters it."""

    noise: FloatArray
    """[1, horizon, 4]: what the first segment starts with."""
    segments: tuple[Segment, ...]
    """Each starts with what the one before made; the last one makes the chunk."""
    guess_share: float
    noise_share: float
    """Shares of a guess and of noise in what the last segment starts with."""

    def sample(self, encoded: FloatArray, state: FloatArray, history: FloatArray) -> FloatArray:
        """All segments, from noise -> chunk [1, horizon, 4]."""
        noisy = self.noise
        for segment in self.segments:
            noisy = segment(encoded, state, history, noisy)
        return noisy

    def refine(
        self, encoded: FloatArray, state: FloatArray, history: FloatArray, guess: FloatArray
    ) -> FloatArray:
        """The last segment, from ``guess`` [1, horizon, 4] -> chunk."""
        noisy = self.guess_share * guess + self.noise_share * self.noise
        return self.segments[-1](encoded, state, history, noisy)


def make_solve(
    start: NoiseModel,
    segment: Callable[[int, int], Segment],
    num_diffusion_steps: int,
    segment_steps: int,
) -> Solve:
    """A solve of ``num_diffusion_steps`` in segments; only the first may have fewer steps.

    ``segment`` makes the function that runs so many steps from a first one on. The initial noise of
    ``start`` is taken as it is now.

    Raises:
        PolicyError: the solve does not have ``segment_steps``.
    """
    if not 1 <= segment_steps <= num_diffusion_steps:
        raise PolicyError(
            f"head_steps must be in 1..{num_diffusion_steps} (num_diffusion_steps), "
            f"got {segment_steps}"
        )
    ends = reversed(range(num_diffusion_steps, 0, -segment_steps))
    spans = [(max(end - segment_steps, 0), min(end, segment_steps)) for end in ends]
    guess_share, noise_share = start.noise_shares(num_diffusion_steps, spans[-1][0])
    return Solve(
        noise=to_numpy(start.initial_noise),
        segments=tuple(segment(first, count) for first, count in spans),
        guess_share=guess_share,
        noise_share=noise_share,
    )


def to_numpy(array: Any) -> FloatArray:
    """A float32 copy of an array of any kind, on any device."""
    return np.array(array.cpu().numpy() if hasattr(array, "cpu") else array, np.float32)


def shift_chunk(chunk: FloatArray, periods: float) -> FloatArray:
    """The chunk [1, horizon, 4] ``periods`` >= 0 of its actions later, its last action held.

    It is linear between two actions.
    """
    last = chunk.shape[1] - 1
    at = np.minimum(np.arange(last + 1) + periods, last)
    low = at.astype(np.intp)
    share = (at - low).astype(np.float32)[:, None]
    moved: FloatArray = chunk[:, low] * (1 - share) + chunk[:, np.minimum(low + 1, last)] * share
    return moved


@dataclass(slots=True)
class _Guess:
    chunk: FloatArray
    age_s: float
    """From the state that it was made from to that of the last call."""


@dataclass(slots=True)
class _SpreadSolve:
    """A full solve on the inputs of the tick where it began, a segment at a time."""

    inputs: tuple[FloatArray, FloatArray, FloatArray]
    noisy: FloatArray
    segments_done: int = 0
    age_s: float = 0.0


class WarmStart:
    """``Executable.act``; keeps a guess of the next chunk. The same calls give the same chunks."""

    def __init__(self, solve: Solve, *, chunk_dt_s: float) -> None:
        self._solve = solve
        self._chunk_dt_s = chunk_dt_s
        self._guess: _Guess | None = None
        self._spread: _SpreadSolve | None = None
        self._since_full_s = 0.0

    def __call__(
        self,
        encoded: FloatArray,
        state: FloatArray,
        history: FloatArray,
        elapsed_s: float | None,
    ) -> FloatArray:
        """A whole solve where there is no guess, or time went backwards; else a refinement."""
        # Taken out of the object: a solve that fails leaves no guess behind.
        guess, self._guess = self._guess, None
        spread, self._spread = self._spread, None
        if guess is None or elapsed_s is None or elapsed_s < 0:
            return self._solve_fully(encoded, state, history)
        guess.age_s += elapsed_s
        if guess.age_s >= FULL_EVERY_S:
            return self._solve_fully(encoded, state, history)
        moved = shift_chunk(guess.chunk, guess.age_s / self._chunk_dt_s)
        chunk = self._solve.refine(encoded, state, history, moved)
        self._guess = _Guess(chunk, 0.0)
        self._since_full_s += elapsed_s
        if spread is not None:
            spread.age_s += elapsed_s
        elif self._since_full_s >= FULL_EVERY_S:
            self._since_full_s = 0.0
            # Copies: the caller may write to its arrays before the last segment reads them.
            inputs = encoded.copy(), state.copy(), history.copy()
            spread = _SpreadSolve(inputs, self._solve.noise)
        if spread is not None:
            self._run_segment(spread)
        return chunk

    def _solve_fully(
        self, encoded: FloatArray, state: FloatArray, history: FloatArray
    ) -> FloatArray:
        self._since_full_s = 0.0
        chunk = self._solve.sample(encoded, state, history)
        self._guess = _Guess(chunk, 0.0)
        return chunk

    def _run_segment(self, spread: _SpreadSolve) -> None:
        spread.noisy = self._solve.segments[spread.segments_done](*spread.inputs, spread.noisy)
        spread.segments_done += 1
        if spread.segments_done < len(self._solve.segments):
            self._spread = spread
        else:
            self._guess = _Guess(spread.noisy, spread.age_s)
