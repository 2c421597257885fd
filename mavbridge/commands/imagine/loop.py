"""The loop of a rollout: decide, simulate, observe, next."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from mavbridge.commands.imagine.deciders import Decider
from mavbridge.commands.imagine.observation import ObservationQueue
from mavbridge.commands.imagine.plan import RolloutPlan, Stage
from mavbridge.commands.imagine.sampling import Sampled, Sampler
from mavbridge.commands.imagine.start import Start
from mavbridge.core.records import FloatArray, ImageArray


@dataclass(frozen=True, kw_only=True)
class Segment:
    """What one iteration shows: ``F`` = ``plan.frames`` imagined steps."""

    iteration: int
    latents: Tensor
    """[F, C, h, w]"""
    states: FloatArray
    """[F, 13]"""
    actions: FloatArray
    """[F, 4], each held until the frame of its row."""
    decoded: dict[int, ImageArray]
    """Frames [H, W, 3] that somebody needed already, by row."""


def rollout(
    sampler: Sampler, decider: Decider, start: Start, plan: RolloutPlan
) -> Iterator[Segment]:
    """Imagine, an iteration a step; nothing is kept from one iteration but the observation.

    Only frames that the decider will look at are decoded here: those of the executed steps that
    will still be in its queue, and none after the last iteration.

    Raises:
        ImaginationError: the world model imagines no numbers.
    """
    seen = ObservationQueue(
        start,
        sampler.encode(start.images),
        frame_dt_s=sampler.config.frame_dt_s,
        images=decider.images,
        contract=decider.contract,
    )
    for iteration in range(plan.iterations):
        actions = decider.decide(seen, plan.stage_seed(iteration, Stage.DECIDE))
        imagined = sampler.sample(
            seen.latents(),
            seen.states(),
            actions,
            seed=plan.stage_seed(iteration, Stage.SIMULATE),
        )
        decoded = _decoded(imagined)
        if iteration + 1 < plan.iterations:
            _decode_needed(sampler, imagined.latents, decider.images, plan.exe_steps, decoded)
            _observe(seen, imagined, actions, plan.exe_steps, decoded)
        yield Segment(
            iteration=iteration,
            latents=imagined.latents[: plan.frames],
            states=imagined.states[: plan.frames],
            actions=actions[: plan.frames],
            decoded={row: rgb for row, rgb in decoded.items() if row < plan.frames},
        )


def _decoded(imagined: Sampled) -> dict[int, ImageArray]:
    return {} if imagined.pixels is None else dict(enumerate(imagined.pixels))


def _decode_needed(
    sampler: Sampler,
    latents: Tensor,
    images: int,
    exe_steps: int,
    decoded: dict[int, ImageArray],
) -> None:
    """Add the newest executed frames that fit into the queue, in one call."""
    rows = [row for row in range(exe_steps)[-images:] if row not in decoded] if images else []
    if rows:
        pixels: NDArray[np.uint8] = sampler.decode(latents[rows[0] : rows[-1] + 1])
        decoded.update(zip(rows, pixels, strict=True))


def _observe(
    seen: ObservationQueue,
    imagined: Sampled,
    actions: FloatArray,
    exe_steps: int,
    decoded: dict[int, ImageArray],
) -> None:
    """Push what was executed, step by step."""
    for row in range(exe_steps):
        seen.push(imagined.latents[row], imagined.states[row], actions[row])
        if row in decoded:
            seen.images.append(decoded[row])
