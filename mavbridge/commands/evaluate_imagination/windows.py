"""One imagined future of each window, scored."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from mavbridge.commands.evaluate.statistics import Estimate, rate
from mavbridge.commands.evaluate_imagination.lens import Array, Lens, attitudes, body_rates
from mavbridge.commands.evaluate_imagination.metrics import psnr_db, slope, spearman, ssim
from mavbridge.commands.evaluate_imagination.registration import turn_between
from mavbridge.commands.evaluate_imagination.results import (
    AXES,
    METHODS,
    TELLERS,
    Axis,
    FrameQuality,
    Method,
    Obedience,
    Reference,
    Teller,
)
from mavbridge.commands.evaluate_imagination.runs import Run
from mavbridge.commands.imagine.loop import MAX_SEED
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.core.records import FloatArray, ImageArray
from policy.contract import ACTION_NAMES

STEPS = (1, 4, 8, 16)
"""Frames ahead that are scored, as far as the model imagines."""
YAW_STICK = ACTION_NAMES.index("yaw")


def noise_seed(seed: int, part: int, *numbers: int) -> int:
    """Seed of one sample: independent of all others, and of which of them are drawn."""
    sequence = np.random.SeedSequence([seed, part, *numbers])
    return int(sequence.generate_state(1, np.uint64)[0]) & MAX_SEED


class LatentRange:
    """The least and greatest latent of each channel in the real frames that were seen."""

    def __init__(self) -> None:
        self._low: Tensor | None = None
        self._high: Tensor | None = None

    def widen(self, latents: Tensor) -> None:
        """Real frames' latents [N, C, h, w]."""
        low, high = latents.amin(dim=(0, 2, 3)), latents.amax(dim=(0, 2, 3))
        self._low = low if self._low is None else torch.minimum(self._low, low)
        self._high = high if self._high is None else torch.maximum(self._high, high)

    def share_outside(self, latents: Tensor) -> float:
        """Of one frame's latents [C, h, w]; none are outside while nothing real was seen."""
        if self._low is None or self._high is None:
            return 0.0
        low, high = self._low[:, None, None], self._high[:, None, None]
        return float(((latents < low) | (latents > high)).float().mean())


@dataclass(frozen=True, kw_only=True)
class _Rates:
    """Body rates [3] of one step, FRD, rad/s, as each source tells them."""

    stick_yaw: float
    told: dict[Teller, Array]


class WindowScorer:
    """Adds up what windows tell; keeps some dozens of numbers of each."""

    def __init__(self, sampler: Sampler, *, seed: int) -> None:
        self._sampler = sampler
        self._seed = seed
        config = sampler.config
        self.steps = tuple(step for step in STEPS if step <= config.frames)
        self._now = config.context_frames - 1
        pairs = {step - 1 for step in self.steps} | set(self.steps)
        self.wanted = sorted({*range(self._now), *(self._now + step for step in pairs)})
        """Steps of a run, from the first of its context, whose images are looked at."""
        self._shown = sorted(pairs - {0})
        self.windows = 0
        self.latents = LatentRange()
        self._sums = {(m, step): np.zeros(2) for m in METHODS for step in self.steps}
        self._rates: list[_Rates] = []
        self._nearer = self._swaps = 0

    def add(
        self,
        run: Run,
        images: dict[int, ImageArray],
        lens: Lens,
        *,
        index: int,
        yaw_rate_radps: float,
        other_actions: FloatArray | None,
    ) -> None:
        """Imagine and score one window.

        Args:
            run: the window.
            images: of the steps ``wanted``.
            lens: of its flight.
            index: of the window; with the seed, all that its noise depends on.
            yaw_rate_radps: of a full stick.
            other_actions: [frames, 4] of another window; None where there is no other.

        Raises:
            ImaginationError: the world model imagines no numbers.
        """
        sampler, now = self._sampler, self._now
        seed = noise_seed(self._seed, 0, index)
        context = sampler.encode(np.stack([images[step] for step in range(now + 1)]))
        past, states = context[None], run.states[None, : now + 1]
        own = sampler.sample(past, states, run.actions, seed=seed)
        real = sampler.encode(np.stack([images[now + step] for step in self.steps]))
        self.latents.widen(context)
        self.latents.widen(real)
        if other_actions is not None:
            swapped = sampler.sample(past, states, other_actions, seed=seed)
            rows = [step - 1 for step in self.steps]
            own_error, swapped_error = (
                float((latents[rows] - real).square().mean())
                for latents in (own.latents, swapped.latents)
            )
            self._swaps += 1
            self._nearer += own_error < swapped_error  # a tie is a model that ignores its sticks
        pixels = sampler.decode(own.latents[[step - 1 for step in self._shown]])
        imagined = dict(zip(self._shown, pixels, strict=True))
        self._score(run, images, lens, imagined, sampler.decode(real))
        imagined[0] = sampler.decode(context[now:])[0]  # seen through the same autoencoder
        imagined_states = np.concatenate([run.states[now : now + 1], own.states])
        self._compare_rates(run, images, lens, imagined, imagined_states, yaw_rate_radps)
        self.windows += 1

    def _score(
        self,
        run: Run,
        images: dict[int, ImageArray],
        lens: Lens,
        imagined: dict[int, ImageArray],
        coded: Sequence[ImageArray] | ImageArray,
    ) -> None:
        turns = attitudes(run.states, self._sampler.config.contract.state_frame)
        last = images[self._now]
        for row, step in enumerate(self.steps):
            at = self._now + step
            made: dict[Method, ImageArray] = {
                "imagined": imagined[step],
                "autoencoder only": coded[row],
                "copy last": last,
                "gyro warp": lens.turned(last, turns[self._now], turns[at]),
            }
            for method, image in made.items():
                score = (psnr_db(image, images[at]), ssim(image, images[at]))
                self._sums[method, step] += score

    def _compare_rates(
        self,
        run: Run,
        images: dict[int, ImageArray],
        lens: Lens,
        imagined: dict[int, ImageArray],
        imagined_states: FloatArray,
        yaw_rate_radps: float,
    ) -> None:
        frame = self._sampler.config.contract.state_frame
        real_states = run.states[self._now :]
        real_turns, imagined_turns = (attitudes(s, frame) for s in (real_states, imagined_states))
        real_rates, imagined_rates = (body_rates(s, frame) for s in (real_states, imagined_states))
        for step in self.steps:
            at = self._now + step
            elapsed_s = float(run.at_s[at] - run.at_s[at - 1])
            seen = turn_between(images[at - 1], images[at], lens, real_turns[step - 1])
            dreamt = turn_between(
                imagined[step - 1], imagined[step], lens, imagined_turns[step - 1]
            )
            self._rates.append(
                _Rates(
                    stick_yaw=float(run.actions[step - 1, YAW_STICK]) * yaw_rate_radps,
                    told={
                        "real states": real_rates[step - 1 : step + 1].mean(axis=0),
                        "imagined states": imagined_rates[step - 1 : step + 1].mean(axis=0),
                        "real frames": seen / elapsed_s,
                        "imagined frames": dreamt / self._sampler.config.frame_dt_s,
                    },
                )
            )

    def frame_quality(self) -> tuple[FrameQuality, ...]:
        """Means over the windows so far; nothing without any."""
        if self.windows == 0:
            return ()
        means = {key: total / self.windows for key, total in self._sums.items()}
        return tuple(
            FrameQuality(method=method, step=step, psnr_db=float(psnr), ssim=float(likeness))
            for (method, step), (psnr, likeness) in means.items()
        )

    def obedience(self) -> tuple[Obedience, ...]:
        """Yaw against the stick, and every axis against what the vehicle really did."""
        if self.windows == 0:
            return ()
        against_stick = [self._follow("yaw", "stick", teller) for teller in TELLERS]
        others = [teller for teller in TELLERS if teller != "real states"]
        axes: tuple[Axis, ...] = ("yaw", "pitch", "roll")
        return (
            *against_stick,
            *(self._follow(axis, "real states", teller) for axis in axes for teller in others),
        )

    def _follow(self, axis: Axis, reference: Reference, teller: Teller) -> Obedience:
        column = AXES.index(axis)
        found = [float(one.told[teller][column]) for one in self._rates]
        if reference == "stick":
            given = [one.stick_yaw for one in self._rates]
        else:
            given = [float(one.told["real states"][column]) for one in self._rates]
        return Obedience(
            axis=axis,
            reference=reference,
            teller=teller,
            slope=slope(given, found),
            spearman=spearman(given, found),
            pairs=len(found),
        )

    def own_actions_nearer(self) -> Estimate | None:
        """Share of windows, with its 95 % interval; None while none was swapped."""
        return rate(self._nearer, self._swaps) if self._swaps else None
