"""The world model as the loop calls it: numpy at the edge, no gradients, every second counted."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.records import FloatArray
from policy.world_model.config import WorldModelConfig
from policy.world_model.model import WorldModel


class ImaginationError(MavbridgeError):
    """A world model that imagines NaN or infinity."""


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use so many threads, at least one, within the ``with`` block."""
    before = torch.get_num_threads()
    torch.set_num_threads(max(1, count))
    try:
        yield
    finally:
        torch.set_num_threads(before)


class Stopwatch:
    """Adds up the time of its ``with`` blocks; not to be nested."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._started_ns = 0
        self.seconds = 0.0

    def __enter__(self) -> None:
        """Start counting."""
        self._started_ns = self._clock.now_ns()

    def __exit__(self, *_: object) -> None:
        """Add what has passed."""
        self.seconds += (self._clock.now_ns() - self._started_ns) / NS_PER_S


class Meter:
    """Time that the loop's own thread spends in each part; written by that thread alone."""

    def __init__(self, clock: Clock) -> None:
        self.sample = Stopwatch(clock)
        self.decode = Stopwatch(clock)
        """Time for pixels: its own decodes, and waits for room in the decode queue."""
        self.write = Stopwatch(clock)
        """Time for the files: its own writing, or waits for the end of the writer's."""
        self.frames_decoded = 0


@dataclass(frozen=True, kw_only=True)
class ImaginedSteps:
    """One sample of the world model."""

    latents: Tensor
    """[frames, C, h, w], on the model's device."""
    states: FloatArray
    """[frames, 13]"""
    actions: FloatArray
    """[frames, 4]"""
    pixels: NDArray[np.uint8] | None
    """[frames, H, W, 3] where everything is decoded at once, or None."""


class Sampler:
    """One world model in both of its roles; used by the loop's thread."""

    def __init__(
        self, model: WorldModel, *, ddim_steps: int, decode_all: bool, clock: Clock
    ) -> None:
        """Adapt a model, which is on its device already.

        ``decode_all`` decodes every sample's frames at once, as the serial way does.
        """
        self.model = model
        self.config: WorldModelConfig = model.config
        self.clock = clock
        self.meter = Meter(clock)
        self._ddim_steps = ddim_steps
        self._decode_all = decode_all
        self._device = next(model.parameters()).device

    def encode(self, images: NDArray[np.uint8]) -> Tensor:
        """Images [N, H, W, 3] -> latents [N, C, h, w]."""
        with torch.inference_mode():
            return self.model.encode(torch.from_numpy(images).to(self._device))

    def decode(self, latents: Tensor) -> NDArray[np.uint8]:
        """Latents [N, C, h, w] -> images [N, H, W, 3].

        On one thread, as ``FrameDecoder``: how a sum is split up decides how it is rounded.
        """
        with torch.inference_mode(), torch_threads(1), self.meter.decode:
            pixels: NDArray[np.uint8] = self.model.decode(latents).cpu().numpy()
        self.meter.frames_decoded += len(pixels)
        return pixels

    def sample(
        self, latents: Tensor, states: FloatArray, actions: FloatArray | None, *, seed: int
    ) -> ImaginedSteps:
        """Simulate the actions [frames, 4], or decide on some where they are None.

        Latents are [1, context_frames, C, h, w], states [1, context_frames, 13]; ``seed`` is that
        of the noise.

        Raises:
            ImaginationError: what came out is not finite.
        """
        with torch.inference_mode(), self.meter.sample:
            imagined = self.model.sample(
                latents,
                self._tensor(states),
                None if actions is None else self._tensor(actions[None]),
                ddim_steps=self._ddim_steps,
                noise_seed=seed,
                sim_mode=actions is not None,
            )
            sampled_states = imagined.states[0].float().cpu().numpy()
            sampled_actions = imagined.actions[0].float().cpu().numpy()
        if not (np.isfinite(sampled_states).all() and np.isfinite(sampled_actions).all()):
            raise ImaginationError(
                "the world model imagined NaN or infinity: its weights are damaged, or it has left "
                "what it was trained on; try more --ddim-steps, or another checkpoint"
            )
        return ImaginedSteps(
            latents=imagined.latents[0],
            states=sampled_states,
            actions=sampled_actions,
            pixels=self.decode(imagined.latents[0]) if self._decode_all else None,
        )

    def _tensor(self, values: FloatArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self._device)
