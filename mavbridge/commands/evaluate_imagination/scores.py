"""Scores of imagined futures: of single windows, and of chains that continue from themselves."""

from collections import defaultdict

import numpy as np
import torch
from numpy.typing import NDArray

from mavbridge.commands.evaluate.statistics import Estimate, rate
from mavbridge.commands.evaluate_imagination.flights import FlightWindow
from mavbridge.commands.evaluate_imagination.results import (
    AXES,
    METHODS,
    DriftIteration,
    FrameQuality,
    RateSource,
    StickFollowing,
)
from mavbridge.commands.imagine.loop import noise_seed
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.core.records import FloatArray, ImageArray
from policy.contract import RATE
from policy.training.world_model.losses import psnr_db as tensor_psnr_db

STEPS = (1, 4, 8, 16)
"""Frames ahead that are scored, as far as the model imagines."""
MIN_PAIRS = 3


def psnr_db(made: ImageArray, true: ImageArray) -> float:
    """Peak signal to noise ratio of two images in dB, at most 99."""
    return float(tensor_psnr_db(torch.from_numpy(made), torch.from_numpy(true)))


def slope(x: NDArray[np.float64], y: NDArray[np.float64]) -> float | None:
    """Least-squares slope of y over x; None where x has no spread."""
    if not _varies(x):
        return None
    x = x - x.mean()
    return float((x * (y - y.mean())).sum() / (x * x).sum())


def spearman(x: NDArray[np.float64], y: NDArray[np.float64]) -> float | None:
    """Rank correlation, equal values sharing their mean rank; None where one has no spread."""
    if not (_varies(x) and _varies(y)):
        return None
    return float(np.corrcoef(_ranks(x), _ranks(y))[0, 1])


def _varies(values: NDArray[np.float64]) -> bool:
    return len(values) >= MIN_PAIRS and bool(values.max() > values.min())


def _ranks(values: NDArray[np.float64]) -> NDArray[np.float64]:
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    ranks: NDArray[np.float64] = (np.cumsum(counts) - (counts - 1) / 2)[place]
    return ranks


class WindowScorer:
    """Scores windows; keeps some dozens of numbers of each."""

    def __init__(self, sampler: Sampler, *, seed: int) -> None:
        self._sampler = sampler
        self._seed = seed
        self._now = sampler.config.context_frames - 1
        self._steps = [step for step in STEPS if step <= sampler.config.frames]
        self.image_steps = [*range(self._now + 1), *(self._now + step for step in self._steps)]
        """Steps of a window, counted from the first of its context, whose images are used."""
        self.windows = 0
        self._psnr_db = {method: np.zeros(len(self._steps)) for method in METHODS}
        self._rates: dict[RateSource, list[NDArray[np.float64]]] = defaultdict(list)
        self._own_nearer = self._swaps = 0

    def add(
        self,
        window: FlightWindow,
        images: dict[int, ImageArray],
        *,
        index: int,
        other_actions: FloatArray | None,
    ) -> None:
        """Imagine and score one window with the images of ``image_steps``.

        The seed and ``index`` determine the noise; ``other_actions`` [frames, 4] are those of
        another window, if there is one.

        Raises:
            ImaginationError: the world model imagines NaN or infinity.
        """
        sampler, now = self._sampler, self._now
        rows = [step - 1 for step in self._steps]
        seed = noise_seed(self._seed, 0, index)
        past = sampler.encode(np.stack([images[step] for step in range(now + 1)]))[None]
        states = window.states[None, : now + 1]
        own = sampler.sample(past, states, window.actions, seed=seed)
        real = sampler.encode(np.stack([images[now + step] for step in self._steps]))
        imagined, coded = sampler.decode(own.latents[rows]), sampler.decode(real)
        for row, step in enumerate(self._steps):
            for method, made in zip(METHODS, (imagined[row], coded[row], images[now]), strict=True):
                self._psnr_db[method][row] += psnr_db(made, images[now + step])
        self._note_rates("real states", window.states[now], window.states[now + 1 :])
        self._note_rates("imagined states", window.states[now], own.states)
        if other_actions is not None:
            swapped = sampler.sample(past, states, other_actions, seed=seed)
            self._note_rates("imagined states, sticks swapped", window.states[now], swapped.states)
            own_error, swapped_error = (
                float((latents[rows] - real).square().mean())
                for latents in (own.latents, swapped.latents)
            )
            self._swaps += 1
            self._own_nearer += own_error < swapped_error  # a tie: the sticks are ignored
        self.windows += 1

    def _note_rates(self, source: RateSource, now: FloatArray, states: FloatArray) -> None:
        rates = np.concatenate([now[None], states])[:, RATE].astype(np.float64)
        self._rates[source] += [rates[step - 1 : step + 1].mean(axis=0) for step in self._steps]

    def frame_quality(self) -> tuple[FrameQuality, ...]:
        """Means over the windows so far; empty without any."""
        return tuple(
            FrameQuality(method=method, step=step, psnr_db=float(total / self.windows))
            for method, totals in self._psnr_db.items()
            for step, total in zip(self._steps, totals, strict=True)
            if self.windows
        )

    def stick_following(self) -> tuple[StickFollowing, ...]:
        """Body rates that were imagined against those of the vehicle, axis by axis."""
        rates = {source: np.array(rows) for source, rows in self._rates.items()}
        return tuple(
            StickFollowing(
                axis=axis,
                source=source,
                slope=slope(rates["real states"][:, column], found[:, column]),
                spearman=spearman(rates["real states"][:, column], found[:, column]),
                pairs=len(found),
            )
            for column, axis in enumerate(AXES)
            for source, found in rates.items()
            if source != "real states"
        )

    def own_actions_nearer(self) -> Estimate | None:
        """Share of windows, with its 95 % interval; None while none was swapped."""
        return rate(self._own_nearer, self._swaps) if self._swaps else None


class DriftScorer:
    """Scores chains: each iteration is imagined from the last imagined frames of the one before."""

    def __init__(self, sampler: Sampler, *, seed: int, exe_steps: int, iterations: int) -> None:
        """Prepare for chains of so many iterations, of which each executes ``exe_steps`` frames."""
        self._sampler = sampler
        self._seed = seed
        self._exe_steps = exe_steps
        self._chains = 0
        self._psnr_db = np.zeros((iterations, len(METHODS)))
        now = sampler.config.context_frames - 1
        self._ends = [now + exe_steps * (n + 1) for n in range(iterations)]
        self.image_steps = [*range(now + 1), *self._ends]
        """Steps of a window, counted from the first of its context, whose images are used."""

    def add(self, window: FlightWindow, images: dict[int, ImageArray], *, index: int) -> None:
        """Imagine and score one chain with the images of ``image_steps``.

        Raises:
            ImaginationError: the world model imagines NaN or infinity.
        """
        sampler, exe_steps = self._sampler, self._exe_steps
        context = sampler.config.context_frames
        latents = sampler.encode(np.stack([images[step] for step in range(context)]))
        states = window.states[:context]
        for iteration, end in enumerate(self._ends):
            actions = window.actions[iteration * exe_steps :][: sampler.config.frames]
            seed = noise_seed(self._seed, 1, index, iteration)
            imagined = sampler.sample(latents[None], states[None], actions, seed=seed)
            latents = torch.cat([latents, imagined.latents[:exe_steps]])[-context:]
            states = np.concatenate([states, imagined.states[:exe_steps]])[-context:]
            real = images[end]
            made = sampler.decode(torch.cat([latents[-1:], sampler.encode(real[None])]))
            methods = (made[0], made[1], images[context - 1])
            self._psnr_db[iteration] += [psnr_db(image, real) for image in methods]
        self._chains += 1

    def iterations(self) -> tuple[DriftIteration, ...]:
        """Means over the chains so far; empty without any."""
        return tuple(
            DriftIteration(
                iteration=index + 1,
                chains=self._chains,
                imagined_psnr_db=imagined / self._chains,
                autoencoder_psnr_db=coded / self._chains,
                copy_last_psnr_db=copied / self._chains,
            )
            for index, (imagined, coded, copied) in enumerate(self._psnr_db.tolist())
            if self._chains
        )
