"""Scores of world models whose worth is known."""

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from helpers.factories import make_state
from helpers.rollouts import TINY
from mavbridge.commands.evaluate_imagination.flights import FlightWindow
from mavbridge.commands.evaluate_imagination.results import StickFollowing
from mavbridge.commands.evaluate_imagination.scores import (
    DriftScorer,
    WindowScorer,
    psnr_db,
    slope,
    spearman,
)
from mavbridge.core.records import FloatArray, ImageArray

SIZE, FRAMES = TINY.image_size, TINY.frames
YAW, YAW_RATE = 1, 9
"""Columns of actions and of states."""
FULL_YAW_RADPS = 3.0

Imagine = Callable[[FloatArray, FloatArray], tuple[NDArray[np.uint8], FloatArray]]


def flat(value: float) -> ImageArray:
    return np.full((SIZE, SIZE, 3), round(value), np.uint8)


def images_of(states: FloatArray) -> NDArray[np.uint8]:
    """Frames that are the brighter the faster the vehicle yaws."""
    return np.stack([flat(128 + 30 * state[YAW_RATE]) for state in states])


def make_window(phase: float, steps: int = FRAMES) -> FlightWindow:
    """A vehicle that yaws as its stick says, at once."""
    sticks = 0.9 * np.sin(0.4 * np.arange(2 + steps) + phase)
    states = np.stack([make_state().values] * len(sticks))
    states[:, YAW_RATE] = FULL_YAW_RADPS * sticks
    actions = np.zeros((steps, 4), np.float32)
    actions[:, YAW] = sticks[2:]
    return FlightWindow(
        folder=Path("flight"), frames=np.arange(len(sticks)), states=states, actions=actions
    )


def following(states: FloatArray, actions: FloatArray) -> tuple[NDArray[np.uint8], FloatArray]:
    """Do what the sticks say; that is the truth, if they are those that were sent."""
    imagined = np.repeat(states[-1:], len(actions), axis=0)
    imagined[:, YAW_RATE] = FULL_YAW_RADPS * actions[:, YAW]
    return images_of(imagined), imagined


def ignoring(states: FloatArray, actions: FloatArray) -> tuple[NDArray[np.uint8], FloatArray]:
    """Leave everything as it is."""
    imagined = np.repeat(states[-1:], len(actions), axis=0)
    return images_of(imagined), imagined


class OracleSampler:
    """Latents are pixels; what is imagined is up to the test."""

    def __init__(self, imagine: Imagine) -> None:
        self.config = TINY
        self._imagine = imagine
        self.seeds: list[int] = []
        self.actions: list[FloatArray] = []
        self.frames_decoded = 0

    def encode(self, images: NDArray[np.uint8]) -> Tensor:
        return torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255

    def decode(self, latents: Tensor) -> NDArray[np.uint8]:
        self.frames_decoded += len(latents)
        pixels = (latents * 255).round().to(torch.uint8).permute(0, 2, 3, 1)
        return pixels.contiguous().numpy()

    def sample(
        self, latents: Tensor, states: FloatArray, actions: FloatArray, *, seed: int
    ) -> SimpleNamespace:
        self.seeds.append(seed)
        self.actions.append(actions)
        images, imagined = self._imagine(states[0], actions)
        return SimpleNamespace(latents=self.encode(images), states=imagined)


def score(imagine: Imagine) -> tuple[WindowScorer, OracleSampler]:
    """Score windows of four flights, each with the sticks of another as the swapped ones."""
    windows = [make_window(phase) for phase in (0.0, 1.5, 3.0, 4.5)]
    sampler = OracleSampler(imagine)
    scorer = WindowScorer(sampler, seed=0)  # type: ignore[arg-type]
    for index, window in enumerate(windows):
        images = dict(enumerate(images_of(window.states)))
        scorer.add(
            window,
            {step: images[step] for step in scorer.image_steps},
            index=index,
            other_actions=windows[(index + 1) % 4].actions,
        )
    return scorer, sampler


def yaw_of(scorer: WindowScorer, source: str) -> StickFollowing:
    (found,) = (r for r in scorer.stick_following() if (r.axis, r.source) == ("yaw", source))
    assert found.pairs == 16
    return found


def psnr_of(scorer: WindowScorer, method: str) -> list[float]:
    return [row.psnr_db for row in scorer.frame_quality() if row.method == method]


def test_a_model_that_is_right_is_found_right() -> None:
    scorer, sampler = score(following)
    assert psnr_of(scorer, "imagined") == psnr_of(scorer, "autoencoder only") == [99.0] * 4
    assert max(psnr_of(scorer, "copy last")) < 40
    own = yaw_of(scorer, "imagined states")
    assert own.slope == pytest.approx(1.0, abs=0.15)  # the step before the first was not imagined
    assert own.spearman == pytest.approx(1.0, abs=0.05)
    swapped = yaw_of(scorer, "imagined states, sticks swapped")
    assert swapped.slope is not None
    assert abs(swapped.slope) < 0.5
    nearer = scorer.own_actions_nearer()
    assert nearer is not None
    assert (nearer.value, nearer.count) == (1.0, 4)
    assert sampler.frames_decoded == 4 * (4 + 4)  # imagined, and real ones through the decoder


def test_a_model_that_ignores_its_sticks_is_found_out() -> None:
    scorer, _ = score(ignoring)
    assert psnr_of(scorer, "imagined") == psnr_of(scorer, "copy last")
    own, swapped = (
        yaw_of(scorer, source) for source in ("imagined states", "imagined states, sticks swapped")
    )
    assert (own.slope, own.spearman) == (swapped.slope, swapped.spearman)
    nearer = scorer.own_actions_nearer()
    assert nearer is not None
    assert nearer.value == 0.0


def test_own_and_swapped_sticks_meet_the_same_noise_and_every_window_its_own() -> None:
    _, sampler = score(following)
    assert sampler.seeds[::2] == sampler.seeds[1::2]
    assert len(set(sampler.seeds)) == 4


def test_nothing_is_reported_before_the_first_window() -> None:
    scorer = WindowScorer(OracleSampler(following), seed=0)  # type: ignore[arg-type]
    assert scorer.frame_quality() == scorer.stick_following() == ()
    assert scorer.own_actions_nearer() is None


def test_a_chain_continues_from_what_was_imagined() -> None:
    window = make_window(0.7, steps=FRAMES + 2 * 4)  # three iterations of four
    level = iter([40, 80, 160])
    seen: list[FloatArray] = []

    def imagine(states: FloatArray, actions: FloatArray) -> tuple[NDArray[np.uint8], FloatArray]:
        seen.append(states)
        value = next(level)
        return np.stack([flat(value)] * FRAMES), np.full((FRAMES, 13), value, np.float32)

    sampler = OracleSampler(imagine)
    scorer = DriftScorer(sampler, seed=3, exe_steps=4, iterations=3)  # type: ignore[arg-type]
    assert scorer.image_steps == [0, 1, 5, 9, 13]
    assert scorer.iterations() == ()
    images = dict(enumerate(images_of(window.states)))
    scorer.add(window, {step: images[step] for step in scorer.image_steps}, index=0)
    found = scorer.iterations()
    assert [(one.iteration, one.chains) for one in found] == [(1, 1), (2, 1), (3, 1)]
    for row, value in enumerate((40, 80, 160)):
        real = images[5 + 4 * row]
        assert found[row].imagined_psnr_db == pytest.approx(psnr_db(flat(value), real))
        assert found[row].autoencoder_psnr_db == 99.0
        assert found[row].copy_last_psnr_db == pytest.approx(psnr_db(images[1], real))
        assert np.array_equal(sampler.actions[row], window.actions[4 * row : 4 * row + FRAMES])
    assert [states[0, 0] for states in seen] == [window.states[0, 0], 40, 80]
    assert len(set(sampler.seeds)) == 3


def test_psnr_of_known_noise() -> None:
    signs = np.random.default_rng(0).integers(0, 2, (SIZE, SIZE, 3)) * 2 - 1
    noisy = (128 + 10 * signs).astype(np.uint8)
    assert psnr_db(noisy, flat(128)) == pytest.approx(20 * math.log10(255 / 10), abs=1e-4)
    assert psnr_db(flat(7), flat(7)) == 99.0


def test_slope_and_spearman_of_a_bent_line() -> None:
    x = np.array([-2.0, -1.0, 0.0, 1.0, 2.0])
    cubes = 0.5 * x**3
    assert spearman(x, cubes) == pytest.approx(1.0)
    assert spearman(x, -cubes) == pytest.approx(-1.0)
    assert slope(x, 3 * x + 7) == pytest.approx(3.0)
    assert slope(x, cubes) == pytest.approx(0.5 * (16 + 1 + 1 + 16) / 10)
    # Equal values share a rank: 1.5 1.5 3 against 1 2 3 has covariance 1.5, variances 1.5 and 2.
    tied, rising = np.array([0.0, 0.0, 1.0]), np.array([1.0, 2.0, 3.0])
    assert spearman(tied, rising) == pytest.approx(1.5 / math.sqrt(1.5 * 2))


@pytest.mark.parametrize("x", [[], [1.0, 2.0], [0.0, 0.0, 0.0]])
def test_without_spread_there_is_no_slope_and_no_rank(x: list[float]) -> None:
    y = np.arange(len(x), dtype=float)
    assert slope(np.array(x), y) is None
    assert spearman(np.array(x), y) is None
    assert spearman(y, np.array(x)) is None
