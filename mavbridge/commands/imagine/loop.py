"""Deciders of the sticks of an imagined flight, and the loop that asks them."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from mavbridge.commands.imagine.inputs import ImaginedSteps, RolloutStart, Sampler
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.records import FloatArray, ImageArray
from mavbridge.core.vehicle import Sticks
from mavbridge.flight.history import SentHistory, sample_chunk
from policy.contract import SINCE_EXPOSURE_DIM, Contract
from policy.protocol import PolicyRunner

SAMPLES_PER_STEP = 8
"""An action of the world model is the mean stick of a step: the mean of so many samples."""
MAX_SEED = 2**63 - 1
"""Largest seed that torch's generators accept."""


class ObservationQueue:
    """The newest latents, states and images, oldest first, and the sticks that were executed.

    Images are appended by the loop once they are decoded: there may be fewer than steps.
    """

    def __init__(
        self,
        start: RolloutStart,
        latents: Tensor,
        *,
        frame_dt_s: float,
        images: int,
        contract: Contract,
    ) -> None:
        """Begin with the observed past, whose images have ``latents`` [context_frames, C, h, w].

        ``images`` and ``contract`` are the decider's.
        """
        self._latents = deque(latents, maxlen=len(latents))
        self._states = deque(start.states, maxlen=len(start.states))
        self.images: deque[ImageArray] = deque(start.images, maxlen=images)
        self._step_ns = round(frame_dt_s * NS_PER_S)
        self._now_ns = start.newest_ns
        self._history = SentHistory(length=contract.history_len, dt_s=contract.history_dt_s)
        for at_ns, sticks in start.sent:
            self._history.append(sticks, at_ns)

    def push(self, latent: Tensor, state: FloatArray, action: FloatArray) -> None:
        """Add a step: latent [C, h, w] and state [13] that followed from holding ``action`` [4]."""
        self._history.append(Sticks(*action.tolist()), self._now_ns)
        self._now_ns += self._step_ns
        self._latents.append(latent)
        self._states.append(state)

    def latents(self) -> Tensor:
        """[1, context_frames, C, h, w]"""
        return torch.stack(tuple(self._latents))[None]

    def states(self) -> FloatArray:
        """[1, context_frames, 13]"""
        return np.stack(self._states)[None]

    def history(self) -> FloatArray:
        """[1, K, 4] as the decider's contract has it, up to now."""
        return self._history.resample(self._now_ns)


class Decider(Protocol):
    """Chooses the sticks."""

    images: int
    """Number of the newest frames that it uses; with 0, none are decoded for it."""
    contract: Contract

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """Sticks [frames, 4] in [-1, 1]: the mean of each step of ``frame_dt_s`` from now on."""
        ...


class PolicyDecider:
    """A policy as it flies: newest image, newest state, sticks that were sent."""

    images = 1

    def __init__(self, runner: PolicyRunner, sampler: Sampler) -> None:
        """Make sure that the two belong together.

        Raises:
            UserError: policy and world model have their states in different frames, or the policy
                takes what nobody imagines.
        """
        seen = runner.contract
        if len(seen.cameras) > 1 or seen.observation_steps > 1 or seen.state_extras:
            raise UserError(
                f"{runner.name} takes several cameras, past observations or a place in the "
                "world; flights are imagined for policies that take the newest image and state"
            )
        if seen.action != "sticks":
            raise UserError(
                f"{runner.name} flies by {seen.action}; flights are imagined from sticks"
            )
        ours, theirs = sampler.config.contract.state_frame, runner.contract.state_frame
        if ours != theirs:
            raise UserError(
                f"the world model takes states in {ours}, the policy {runner.name} in "
                f"{theirs}: use two that were trained on the same kind of flights"
            )
        self.contract = runner.contract
        self._runner = runner
        self._frames = sampler.config.frames
        self._frame_dt_s = sampler.config.frame_dt_s

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """The mean of one chunk over each step; its noise was fixed when the policy was loaded."""
        state = seen.states()[:, -1]
        if self.contract.since_exposure:
            # The image is as old as the state: nothing has moved since.
            state = np.pad(state, ((0, 0), (0, SINCE_EXPOSURE_DIM)))
        feature = self._runner.encode(seen.images[-1])
        chunk = self._runner.act(feature, state, seen.history())[0]
        sticks = [
            sample_chunk(
                chunk,
                chunk_dt_s=self.contract.chunk_dt_s,
                at_s=(sample + 0.5) / SAMPLES_PER_STEP * self._frame_dt_s,
            )
            for sample in range(self._frames * SAMPLES_PER_STEP)
        ]
        of_steps = np.array(sticks, np.float32).reshape(self._frames, SAMPLES_PER_STEP, -1)
        clipped: FloatArray = np.clip(of_steps.mean(axis=1), -1.0, 1.0)
        return clipped


class WorldModelDecider:
    """The world model itself, with the actions part of what it samples."""

    def __init__(self, sampler: Sampler, *, from_pixels: bool) -> None:
        """``from_pixels``: it looks at its own frames, decoded and encoded again."""
        self.images = sampler.config.context_frames if from_pixels else 0
        self.contract = sampler.config.contract
        self._sampler = sampler

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """The actions of one sample, whose latents are not used."""
        if self.images:
            latents = self._sampler.encode(np.stack(seen.images))[None]
        else:
            latents = seen.latents()
        return self._sampler.sample(latents, seen.states(), None, seed=seed).actions


class NoiseStage(IntEnum):
    """Step of an iteration that draws noise. The number is part of every seed: never renumber."""

    DECIDE = 0
    SIMULATE = 1


def noise_seed(*numbers: int) -> int:
    """Seed of one sample, independent of those of all other numbers."""
    sequence = np.random.SeedSequence(numbers)
    return int(sequence.generate_state(1, np.uint64)[0]) & MAX_SEED


@dataclass(frozen=True, kw_only=True)
class RolloutPlan:
    """One rollout.

    Raises:
        UserError: more steps are to be executed than are imagined.
    """

    iterations: int
    frames: int
    """Number of each iteration's imagined frames that are shown, from the first on."""
    exe_steps: int
    """Number of its actions that are executed before the next decision."""
    ddim_steps: int
    seed: int

    def __post_init__(self) -> None:
        """Refuse a plan that no iteration can keep."""
        if self.exe_steps > self.frames:
            raise UserError(
                f"--exe-steps {self.exe_steps} is more than --frames {self.frames}: only frames "
                "that are imagined can be gone through; lower the one or raise the other"
            )

    def stage_seed(self, iteration: int, stage: NoiseStage) -> int:
        """Seed of one stage of one iteration of this rollout: independent of all others."""
        return noise_seed(self.seed, iteration, int(stage))


@dataclass(frozen=True, kw_only=True)
class Segment:
    """ImaginedSteps steps of one iteration that are shown: ``F`` = ``plan.frames`` of them."""

    iteration: int
    latents: Tensor
    """[F, C, h, w]"""
    states: FloatArray
    """[F, 13]"""
    actions: FloatArray
    """[F, 4], each held until the frame of its row."""
    decoded: dict[int, ImageArray]
    """Frames [H, W, 3] that have been decoded already, by row."""


def rollout(
    sampler: Sampler, decider: Decider, start: RolloutStart, plan: RolloutPlan
) -> Iterator[Segment]:
    """Imagine, an iteration a step; nothing is kept from one iteration but the observation.

    Only frames that the decider will look at are decoded here: those of the executed steps that
    will still be in its queue, and none after the last iteration.

    Raises:
        ImaginationError: the world model imagines NaN or infinity.
    """
    seen = ObservationQueue(
        start,
        sampler.encode(start.images),
        frame_dt_s=sampler.config.frame_dt_s,
        images=decider.images,
        contract=decider.contract,
    )
    for iteration in range(plan.iterations):
        actions = decider.decide(seen, plan.stage_seed(iteration, NoiseStage.DECIDE))
        imagined = sampler.sample(
            seen.latents(),
            seen.states(),
            actions,
            seed=plan.stage_seed(iteration, NoiseStage.SIMULATE),
        )
        decoded = {} if imagined.pixels is None else dict(enumerate(imagined.pixels))
        if iteration + 1 < plan.iterations:
            decoded |= _decode_needed(sampler, imagined, decider.images, plan.exe_steps)
            for row in range(plan.exe_steps):
                seen.push(imagined.latents[row], imagined.states[row], actions[row])
                if row in decoded:
                    seen.images.append(decoded[row])
        yield Segment(
            iteration=iteration,
            latents=imagined.latents[: plan.frames],
            states=imagined.states[: plan.frames],
            actions=actions[: plan.frames],
            decoded={row: rgb for row, rgb in decoded.items() if row < plan.frames},
        )


def _decode_needed(
    sampler: Sampler, imagined: ImaginedSteps, images: int, exe_steps: int
) -> dict[int, ImageArray]:
    """The newest executed frames that fit into the decider's queue, by row, in one call."""
    if images == 0 or imagined.pixels is not None:
        return {}
    rows = range(exe_steps)[-images:]
    pixels = sampler.decode(imagined.latents[rows.start : rows.stop])
    return dict(zip(rows, pixels, strict=True))
