"""The loop of a rollout: decide, simulate, observe, next."""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from torch import Tensor

from mavbridge.commands.imagine.deciders import Decider, ObservationQueue
from mavbridge.commands.imagine.sampling import ImaginedSteps, Sampler
from mavbridge.commands.imagine.start import RolloutStart
from mavbridge.core.errors import UserError
from mavbridge.core.records import FloatArray, ImageArray

MAX_SEED = 2**63 - 1
"""Largest seed that torch's generators accept."""


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
