"""What is said of world models whose worth is known."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from helpers.panoramas import (
    YAW_RATE_RADPS,
    attitude,
    heading_rad,
    nominal_lens,
    panorama,
    state_of,
    yaw_stick,
)
from helpers.rollouts import TINY
from mavbridge.commands.evaluate_imagination.drift import ITERATIONS, DriftScorer
from mavbridge.commands.evaluate_imagination.metrics import psnr_db
from mavbridge.commands.evaluate_imagination.results import FrameQuality, Obedience
from mavbridge.commands.evaluate_imagination.runs import Run
from mavbridge.commands.evaluate_imagination.windows import LatentRange, WindowScorer
from mavbridge.core.records import FloatArray, ImageArray

SIZE, DT_S = TINY.image_size, TINY.frame_dt_s


@dataclass(frozen=True)
class Scene:
    """A run that yaws as its stick says, with all of its images."""

    run: Run
    images: dict[int, ImageArray]


def make_scene(phase: float, steps: int = TINY.frames) -> Scene:
    times = np.arange(2 + steps) * DT_S
    lens = nominal_lens(SIZE)
    headings = [heading_rad(t, phase) for t in times]
    states = np.stack([state_of(0.0, 0.0, heading) for heading in headings])
    states[:, 9] = [YAW_RATE_RADPS * yaw_stick(t, phase) for t in times]
    actions = np.zeros((steps, 4), np.float32)
    actions[:, 1] = np.diff(headings)[1:] / DT_S / YAW_RATE_RADPS  # the mean from frame to frame
    run = Run(
        folder=Path("scene"),
        frames=np.arange(2 + steps),
        at_s=times,
        states=states.astype(np.float32),
        actions=actions,
    )
    return Scene(run, {k: panorama(lens, attitude(yaw_rad=h)) for k, h in enumerate(headings)})


Imagine = Callable[[FloatArray, int], tuple[NDArray[np.uint8], FloatArray]]


class OracleSampler:
    """Latents are pixels, halved in size; what is imagined is up to the test."""

    def __init__(self, imagine: Imagine) -> None:
        self.config = TINY
        self._imagine = imagine
        self.decoded = 0
        self.seeds: list[int] = []

    def encode(self, images: NDArray[np.uint8]) -> Tensor:
        return torch.from_numpy(images).permute(0, 3, 1, 2).float() / 255

    def decode(self, latents: Tensor) -> NDArray[np.uint8]:
        self.decoded += len(latents)
        pixels = (latents * 255).round().to(torch.uint8).permute(0, 2, 3, 1)
        return pixels.contiguous().numpy()

    def sample(
        self, latents: Tensor, states: FloatArray, actions: FloatArray, *, seed: int
    ) -> SimpleNamespace:
        self.seeds.append(seed)
        images, imagined_states = self._imagine(actions, len(self.seeds) - 1)
        return SimpleNamespace(latents=self.encode(images), states=imagined_states)


def obeying(scene: Scene) -> Imagine:
    """Turns as it is told; the truth, if told the truth."""

    def imagine(actions: FloatArray, _: int) -> tuple[NDArray[np.uint8], FloatArray]:
        start = 2 * np.arccos(np.clip(scene.run.states[1, 3], -1, 1))
        start *= np.sign(scene.run.states[1, 6]) or 1.0
        headings = start + np.cumsum(actions[:, 1]) * DT_S * YAW_RATE_RADPS
        states = np.stack([state_of(0.0, 0.0, h) for h in headings]).astype(np.float32)
        states[:, 9] = actions[:, 1] * YAW_RATE_RADPS
        lens = nominal_lens(SIZE)
        return np.stack([panorama(lens, attitude(yaw_rad=h)) for h in headings]), states

    return imagine


def frozen(scene: Scene) -> Imagine:
    """Nothing ever moves, whatever the sticks."""

    def imagine(actions: FloatArray, _: int) -> tuple[NDArray[np.uint8], FloatArray]:
        states = scene.run.states[1:2].repeat(len(actions), axis=0).copy()
        states[:, 7:10] = 0
        return np.stack([scene.images[1]] * len(actions)), states

    return imagine


def score(make: Callable[[Scene], Imagine]) -> tuple[WindowScorer, list[OracleSampler]]:
    """Windows of several flights, each with the sticks of the next as the other's."""
    scenes = [make_scene(phase) for phase in (0.0, 1.5, 3.0, 4.5)]
    scorer: WindowScorer | None = None
    samplers = []
    for index, scene in enumerate(scenes):
        sampler = OracleSampler(make(scene))
        samplers.append(sampler)
        if scorer is None:
            scorer = WindowScorer(sampler, seed=0)  # type: ignore[arg-type]
        scorer._sampler = sampler  # type: ignore[assignment]
        scorer.add(
            scene.run,
            {step: scene.images[step] for step in scorer.wanted},
            nominal_lens(SIZE),
            index=index,
            yaw_rate_radps=YAW_RATE_RADPS,
            other_actions=scenes[(index + 2) % 4].run.actions,
        )
    assert scorer is not None
    return scorer, samplers


def rows_of(rows: tuple[Obedience, ...], teller: str, reference: str) -> Obedience:
    (found,) = (r for r in rows if (r.axis, r.teller, r.reference) == ("yaw", teller, reference))
    return found


def quality_of(rows: tuple[FrameQuality, ...], method: str) -> list[float]:
    return [row.psnr_db for row in rows if row.method == method]


def test_a_model_that_is_right_is_told_so() -> None:
    scorer, samplers = score(obeying)
    frames = scorer.frame_quality()
    assert min(quality_of(frames, "imagined")) > 40
    assert quality_of(frames, "autoencoder only") == [99.0] * 4
    for copied, warped in zip(
        quality_of(frames, "copy last")[1:], quality_of(frames, "gyro warp")[1:], strict=True
    ):
        assert warped > copied + 1
    for teller in ("imagined states", "imagined frames", "real frames"):
        row = rows_of(scorer.obedience(), teller, "stick")
        assert row.slope == pytest.approx(1.0, abs=0.1), teller
        assert row.spearman == pytest.approx(1.0, abs=0.05), teller
        assert row.pairs == 16
    nearer = scorer.own_actions_nearer()
    assert nearer is not None
    assert (nearer.value, nearer.count) == (1.0, 4)
    # Of the sixteen frames 1 3 4 7 8 15 16; of the real ones the context's last and 1 4 8 16.
    assert samplers[0].decoded == 7 + 1 + 4


def test_a_model_that_ignores_its_sticks_is_told_so() -> None:
    scorer, _ = score(frozen)
    frames = scorer.frame_quality()
    assert quality_of(frames, "imagined") == quality_of(frames, "copy last")
    states = rows_of(scorer.obedience(), "imagined states", "stick")
    pixels = rows_of(scorer.obedience(), "imagined frames", "stick")
    assert states.slope is not None
    assert pixels.slope is not None
    assert abs(pixels.slope) < 0.01
    assert rows_of(scorer.obedience(), "real frames", "stick").spearman > 0.9  # type: ignore[operator]
    nearer = scorer.own_actions_nearer()
    assert nearer is not None
    assert nearer.value == 0.0


def test_own_and_swapped_sticks_meet_the_same_noise() -> None:
    _, samplers = score(obeying)
    pairs = [tuple(sampler.seeds) for sampler in samplers]
    assert all(own == swapped for own, swapped in pairs)
    assert len(set(pairs)) == len(pairs)


def test_latents_beyond_all_real_ones_are_outside() -> None:
    latents = LatentRange()
    assert latents.share_outside(torch.full((2, 4, 4), 9.0)) == 0.0
    latents.widen(torch.tensor([-1.0, 0.0, 0.0, 1.0]).reshape(1, 1, 2, 2).expand(1, 2, 2, 2))
    latents.widen(torch.full((3, 2, 2, 2), 2.0))
    frame = torch.tensor([[[-2.0, -1.0], [0.0, 2.0]], [[2.1, 3.0], [0.0, 0.0]]])
    assert latents.share_outside(frame) == pytest.approx(3 / 8)


def test_a_chain_goes_on_from_what_was_imagined_and_is_scored_where_it_can_be() -> None:
    scene = make_scene(0.7, steps=16 + 2 * 4)  # three iterations of four
    seen: list[FloatArray] = []
    level = [40, 80, 160, 250, 250, 250, 250, 250, 250, 250]

    def imagine(actions: FloatArray, call: int) -> tuple[NDArray[np.uint8], FloatArray]:
        seen.append(actions)
        images = np.full((16, SIZE, SIZE, 3), level[call], np.uint8)
        return images, np.full((16, 13), call, np.float32)

    latents = LatentRange()
    latents.widen(torch.tensor([0.0, 200 / 255]).reshape(2, 1, 1, 1).expand(2, 3, 1, 1))
    sampler = OracleSampler(imagine)
    scorer = DriftScorer(sampler, seed=3, exe_steps=4, latents=latents)  # type: ignore[arg-type]
    assert scorer.wanted(3) == [0, 1, 5, 9, 13]
    assert scorer.iterations() == ()
    scorer.add(scene.run, {step: scene.images[step] for step in scorer.wanted(3)}, index=0)
    found = scorer.iterations()
    assert [one.iteration for one in found] == list(range(1, ITERATIONS + 1))
    assert [one.scored for one in found] == [1, 1, 1] + [0] * 7
    assert [one.left_range for one in found] == [0, 0, 0] + [1] * 7
    for row in range(3):
        flat = np.full((SIZE, SIZE, 3), level[row], np.uint8)
        real = scene.images[5 + 4 * row]
        assert found[row].imagined_psnr_db == pytest.approx(psnr_db(flat, real))
        assert found[row].autoencoder_psnr_db == 99.0
        assert found[row].copy_last_psnr_db == pytest.approx(psnr_db(scene.images[1], real))
    assert found[3].imagined_psnr_db is None
    assert np.array_equal(seen[2], scene.run.actions[8:24])
    assert np.array_equal(seen[3][:12], scene.run.actions[12:24])  # known, though not asked for
    assert not seen[3][12:].any()
    assert not seen[6].any()
    assert len(set(sampler.seeds)) == ITERATIONS
