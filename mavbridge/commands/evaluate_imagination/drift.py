"""Imagination that goes on from itself: what is left of it after so many iterations."""

from dataclasses import dataclass

import numpy as np
import torch

from mavbridge.commands.evaluate_imagination.metrics import psnr_db
from mavbridge.commands.evaluate_imagination.results import DriftIteration
from mavbridge.commands.evaluate_imagination.runs import Run
from mavbridge.commands.evaluate_imagination.windows import LatentRange, noise_seed
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.core.records import FloatArray, ImageArray
from policy.contract import ACTION_DIM

ITERATIONS = 10
OUTSIDE = 0.01
"""Share of a frame's latents beyond the least and greatest of real frames: it has left them."""


@dataclass
class _Sums:
    chains: int = 0
    scored: int = 0
    left: int = 0
    imagined_db: float = 0.0
    coded_db: float = 0.0
    copied_db: float = 0.0


class DriftScorer:
    """Adds up what chains tell."""

    def __init__(
        self, sampler: Sampler, *, seed: int, exe_steps: int, latents: LatentRange
    ) -> None:
        """Prepare.

        Args:
            sampler: of the world model.
            seed: of all noise.
            exe_steps: after which an iteration is followed by the next.
            latents: of real frames.
        """
        self._sampler = sampler
        self._seed = seed
        self._exe_steps = exe_steps
        self._latents = latents
        self._context = sampler.config.context_frames
        self._sums = [_Sums() for _ in range(ITERATIONS)]

    def wanted(self, iterations: int) -> list[int]:
        """Steps of a run, from the first of its context, whose images are looked at."""
        ends = [self._context - 1 + self._exe_steps * (n + 1) for n in range(iterations)]
        return [*range(self._context), *ends]

    def add(self, run: Run, images: dict[int, ImageArray], *, index: int) -> None:
        """Imagine and score one chain.

        Args:
            run: its sticks are followed; once they end, the sticks are centred.
            images: of the steps ``wanted``.
            index: of the chain; with the seed, all that its noise depends on.

        Raises:
            ImaginationError: the world model imagines no numbers.
        """
        sampler, exe_steps = self._sampler, self._exe_steps
        last = images[self._context - 1]
        latents = sampler.encode(np.stack([images[step] for step in range(self._context)]))
        states = run.states[: self._context]
        for iteration, sums in enumerate(self._sums):
            actions = self._actions(run, iteration)
            seed = noise_seed(self._seed, 1, index, iteration)
            imagined = sampler.sample(latents[None], states[None], actions, seed=seed)
            latents = torch.cat([latents, imagined.latents[:exe_steps]])[-self._context :]
            states = np.concatenate([states, imagined.states[:exe_steps]])[-self._context :]
            sums.chains += 1
            sums.left += self._latents.share_outside(latents[-1]) > OUTSIDE
            real = images.get(self._context - 1 + exe_steps * (iteration + 1))
            if real is not None:
                coded = sampler.encode(real[None])
                made = sampler.decode(torch.cat([latents[-1:], coded]))
                sums.scored += 1
                sums.imagined_db += psnr_db(made[0], real)
                sums.coded_db += psnr_db(made[1], real)
                sums.copied_db += psnr_db(last, real)

    def _actions(self, run: Run, iteration: int) -> FloatArray:
        """[frames, 4]"""
        frames = self._sampler.config.frames
        actions = np.zeros((frames, ACTION_DIM), np.float32)
        recorded = run.actions[iteration * self._exe_steps :][:frames]
        actions[: len(recorded)] = recorded
        return actions

    def iterations(self) -> tuple[DriftIteration, ...]:
        """What was found so far; nothing without a chain."""
        if self._sums[-1].chains == 0:
            return ()
        return tuple(_summed(index + 1, sums) for index, sums in enumerate(self._sums))


def _summed(iteration: int, sums: _Sums) -> DriftIteration:
    def mean(total: float) -> float | None:
        return total / sums.scored if sums.scored else None

    return DriftIteration(
        iteration=iteration,
        chains=sums.chains,
        scored=sums.scored,
        imagined_psnr_db=mean(sums.imagined_db),
        autoencoder_psnr_db=mean(sums.coded_db),
        copy_last_psnr_db=mean(sums.copied_db),
        left_range=sums.left / sums.chains,
    )
