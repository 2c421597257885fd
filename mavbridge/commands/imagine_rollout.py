"""The world model, the deciders of the sticks in an imagined flight, and the loop of both."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError, UserError
from mavbridge.core.records import FloatArray, ImageArray
from mavbridge.core.vehicle import Action, Sticks
from mavbridge.flight.history import SentHistory
from policy.contract import SINCE_EXPOSURE_DIM, STICK_TERMS, Contract
from policy.engines.torch_engines import torch_threads
from policy.nets.world_model.config import WorldModelConfig
from policy.nets.world_model.model import WorldModel
from policy.protocol import PolicyRunner

SAMPLES_PER_STEP = 8
"""Samples whose mean is one action of the world model, the mean stick of a step."""
MAX_SEED = 2**63 - 1
"""Largest seed that torch's generators accept."""


class RolloutError(MavbridgeError):
    """The rollout had to end; the part written so far is readable."""


class Sampler:
    """One world model in both roles, simulation and decision. Used by the loop's thread."""

    def __init__(self, model: WorldModel, *, ddim_steps: int) -> None:
        self.model = model
        self.config: WorldModelConfig = model.config
        self._ddim_steps = ddim_steps
        self._device = next(model.parameters()).device

    def encode(self, images: NDArray[np.uint8]) -> Tensor:
        """Encode images [N, H, W, 3] to latents [N, C, h, w]."""
        with torch.inference_mode():
            return self.model.encode(torch.from_numpy(images).to(self._device))

    def decode(self, latents: Tensor) -> NDArray[np.uint8]:
        """Decode latents [N, C, h, w] to images [N, H, W, 3].

        On one thread, like the decoder's, because splitting a sum changes its rounding.
        """
        with torch.inference_mode(), torch_threads(1):
            pixels: NDArray[np.uint8] = self.model.decode(latents).cpu().numpy()
        return pixels

    def sample(
        self, latents: Tensor, states: FloatArray, actions: FloatArray | None, *, seed: int
    ) -> tuple[Tensor, FloatArray, FloatArray]:
        """Simulate the actions [frames, 4], or sample ones if None; raise RolloutError for NaN.

        Return latents [frames, C, h, w], on the model's device, states [frames, 13] and actions.

        Latents are [1, context_frames, C, h, w], states [1, context_frames, 13]; ``seed`` is that
        of the noise.
        """
        with torch.inference_mode():
            imagined = self.model.sample(
                latents,
                self._tensor(states),
                None if actions is None else self._tensor(actions[None]),
                ddim_steps=self._ddim_steps,
                noise_seed=seed,
            )
            sampled_states = imagined.states[0].float().cpu().numpy()
            sampled_actions = imagined.actions[0].float().cpu().numpy()
        if not (np.isfinite(sampled_states).all() and np.isfinite(sampled_actions).all()):
            raise RolloutError(
                "the world model imagined NaN or infinity: its weights are damaged, or it has left "
                "what it was trained on; try more --ddim-steps, or another checkpoint"
            )
        return imagined.latents[0], sampled_states, sampled_actions

    def _tensor(self, values: FloatArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self._device)


@dataclass(frozen=True, kw_only=True)
class RolloutStart:
    """Observed past of a rollout, oldest first; the newest frame is its time zero."""

    images: NDArray[np.uint8]
    """[context_frames, H, W, 3] at the world model's size."""
    states: FloatArray
    """[context_frames, 13]"""
    newest_ns: int
    """Exposure of the newest frame, on the flight's clock."""
    sent: tuple[tuple[int, Action | None], ...]
    """Sticks sent before ``newest_ns``, each with its time; None: released."""


class ObservationQueue:
    """Newest latents, states and images, oldest first, and the executed sticks.

    The loop appends images once they are decoded: there can be fewer images than steps.
    """

    def __init__(self, start: RolloutStart, sampler: Sampler, decider: "Decider") -> None:
        self._latents = deque(sampler.encode(start.images), maxlen=len(start.images))
        self._states = deque(start.states, maxlen=len(start.states))
        self.images: deque[ImageArray] = deque(start.images, maxlen=decider.images)
        self._step_ns = round(sampler.config.frame_dt_s * NS_PER_S)
        self.now_ns = start.newest_ns
        """Exposure of the newest frame, on the flight's clock."""
        self._history = SentHistory(decider.contract)
        for at_ns, sticks in start.sent:
            self._history.append(sticks, at_ns)

    def push(self, latent: Tensor, state: FloatArray, action: FloatArray) -> None:
        """Add a step: latent [C, h, w] and state [13] that result from holding ``action`` [4]."""
        self._history.append(Sticks(*action.tolist()), self.now_ns)
        self.now_ns += self._step_ns
        self._latents.append(latent)
        self._states.append(state)

    def latents(self) -> Tensor:
        """Return the newest latents, [1, context_frames, C, h, w]."""
        return torch.stack(tuple(self._latents))[None]

    def states(self) -> FloatArray:
        """Return the newest states, [1, context_frames, 13]."""
        return np.stack(self._states)[None]

    def history(self) -> FloatArray:
        """Return the executed sticks up to now by the decider's contract, [1, K, 4]."""
        return self._history.resample(self.now_ns)


class Decider(Protocol):
    """Chooses the sticks."""

    images: int
    """Number of newest frames that it uses; with 0, none are decoded for it."""
    contract: Contract

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """Return sticks [frames, 4] in [-1, 1]: the mean of each ``frame_dt_s`` from now on."""
        ...


def require_terms(world: Contract, other: Contract, what: str) -> None:
    """Raise UserError if the axes of the states, or what a stick did, are not the world model's."""
    for name in ("state_frame", *STICK_TERMS):
        ours, theirs = getattr(world, name), getattr(other, name)
        if ours != theirs and not (name == "modes" and set(ours) & set(theirs)):
            raise UserError(
                f"the world model was trained with {name} {ours}, {what} has {theirs}: name two of "
                "the same kind of flights"
            )


class PolicyDecider:
    """A policy as in flight: newest image, newest state, sent sticks."""

    images = 1

    def __init__(self, runner: PolicyRunner, sampler: Sampler, clock: Clock) -> None:
        """Raise UserError if policy and world model do not fit; ``clock`` is the policy's."""
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
        require_terms(sampler.config.contract, seen, f"the policy {runner.name}")
        self.contract = runner.contract
        self._runner, self._clock = runner, clock
        self._frames = sampler.config.frames
        self._frame_dt_s = sampler.config.frame_dt_s

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """Return a chunk's mean over each step. Its noise was fixed when the policy was loaded."""
        self._clock.sleep_until_ns(seen.now_ns)
        state = seen.states()[:, -1]
        if self.contract.since_exposure:
            # Image and state have the same age: no motion since the exposure.
            state = np.pad(state, ((0, 0), (0, SINCE_EXPOSURE_DIM)))
        feature = self._runner.encode(seen.images[-1])
        prefix = (0, 0), (0, self.contract.prefix_len), (0, 0)  # NaN: deciding takes no time here
        history = np.pad(seen.history(), prefix, constant_values=np.nan)
        chunk = self._runner.act(feature, state, history)[0]
        samples = np.arange(self._frames * SAMPLES_PER_STEP)
        samples_s = (samples + 0.5) / SAMPLES_PER_STEP * self._frame_dt_s
        rows_s = np.arange(len(chunk)) * self.contract.chunk_dt_s
        sticks = np.array([np.interp(samples_s, rows_s, stick) for stick in chunk.T], np.float32)
        of_steps = sticks.T.reshape(self._frames, SAMPLES_PER_STEP, -1)
        clipped: FloatArray = np.clip(of_steps.mean(axis=1), -1.0, 1.0)
        return clipped


class WorldModelDecider:
    """The world model as its own decider, by the sampled actions."""

    def __init__(self, sampler: Sampler, *, from_pixels: bool) -> None:
        """Decide from latents, or with ``from_pixels`` from its own frames, encoded again."""
        self.images = sampler.config.context_frames if from_pixels else 0
        self.contract = sampler.config.contract
        self._sampler = sampler

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """Return the actions of one sample; its latents are not used."""
        if self.images:
            latents = self._sampler.encode(np.stack(seen.images))[None]
        else:
            latents = seen.latents()
        _, _, actions = self._sampler.sample(latents, seen.states(), None, seed=seed)
        return actions


DECIDE, SIMULATE = 0, 1
"""Stages of an iteration that draw noise. The numbers are part of every seed: never renumber."""


@dataclass(frozen=True, kw_only=True)
class RolloutPlan:
    """Settings of one rollout."""

    iterations: int
    frames: int
    """Number of imagined frames that are shown in each iteration, from the first on."""
    exe_steps: int
    """Number of actions executed before the next decision."""
    seed: int

    def stage_seed(self, iteration: int, stage: int) -> int:
        """Return the seed of one stage of one iteration, independent of all others."""
        sequence = np.random.SeedSequence((self.seed, iteration, stage))
        return int(sequence.generate_state(1, np.uint64)[0]) & MAX_SEED


@dataclass(frozen=True, kw_only=True)
class Segment:
    """Imagined steps of one iteration that are shown: ``F`` = ``plan.frames`` of them."""

    iteration: int
    latents: Tensor
    """[F, C, h, w]"""
    states: FloatArray
    """[F, 13]"""
    actions: FloatArray
    """[F, 4], each held until the frame of its row."""
    decoded: dict[int, ImageArray]
    """Frames [H, W, 3] that are already decoded, by row."""


def rollout(
    sampler: Sampler, decider: Decider, start: RolloutStart, plan: RolloutPlan
) -> Iterator[Segment]:
    """Imagine an iteration per step; only the observation carries over. Raises RolloutError.

    Only frames that the decider uses are decoded here: those of the executed steps that will still
    be in its queue, and none after the last iteration.
    """
    seen = ObservationQueue(start, sampler, decider)
    for iteration in range(plan.iterations):
        actions = decider.decide(seen, plan.stage_seed(iteration, DECIDE))
        seed = plan.stage_seed(iteration, SIMULATE)
        latents, states, _ = sampler.sample(seen.latents(), seen.states(), actions, seed=seed)
        decoded: dict[int, ImageArray] = {}
        if iteration + 1 < plan.iterations:
            if rows := range(plan.exe_steps)[-decider.images :] if decider.images else ():
                pixels = sampler.decode(latents[rows[0] : plan.exe_steps])
                decoded = dict(zip(rows, pixels, strict=True))
            for row in range(plan.exe_steps):
                seen.push(latents[row], states[row], actions[row])
                if row in decoded:
                    seen.images.append(decoded[row])
        yield Segment(
            iteration=iteration,
            latents=latents[: plan.frames],
            states=states[: plan.frames],
            actions=actions[: plan.frames],
            decoded={row: rgb for row, rgb in decoded.items() if row < plan.frames},
        )
