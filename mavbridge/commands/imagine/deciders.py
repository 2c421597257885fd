"""Who holds the sticks of a rollout."""

from typing import Protocol

import numpy as np

from mavbridge.commands.imagine.observation import ObservationQueue
from mavbridge.commands.imagine.sampling import Sampler
from mavbridge.core.errors import UserError
from mavbridge.core.records import FloatArray
from mavbridge.flight.history import sample_chunk
from policy.contract import SINCE_EXPOSURE_DIM, Contract, Executable

READS_A_STEP = 8
"""An action of the world model is the mean stick of a step; a chunk is read so often for it."""


class Decider(Protocol):
    """Chooses the sticks."""

    images: int
    """Pixels of how many of the newest frames it looks at; none are decoded for one with 0."""
    contract: Contract

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """Sticks [frames, 4] in [-1, 1]: the mean of each step of ``frame_dt_s`` from now on."""
        ...


class PolicyDecider:
    """A policy as it flies: newest image, newest state, sticks that were sent."""

    images = 1

    def __init__(self, executable: Executable, sampler: Sampler) -> None:
        """Make sure that the two belong together.

        Raises:
            UserError: policy and world model have their states in different frames.
        """
        ours, theirs = sampler.config.contract.state_frame, executable.contract.state_frame
        if ours != theirs:
            raise UserError(
                f"the world model takes states in {ours}, the policy {executable.name} in "
                f"{theirs}: use two that were trained on the same kind of flights"
            )
        self.contract = executable.contract
        self._executable = executable
        self._frames = sampler.config.frames
        self._frame_dt_s = sampler.config.frame_dt_s

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """One chunk, its mean over each step; its noise was fixed when it was loaded."""
        state = seen.states()[:, -1]
        if self.contract.since_exposure:
            # The image is as old as the state: nothing has moved since.
            state = np.pad(state, ((0, 0), (0, SINCE_EXPOSURE_DIM)))
        feature = self._executable.encode(seen.images[-1])
        chunk = self._executable.act(feature, state, seen.history(), None)[0]
        sticks = [
            sample_chunk(
                chunk,
                chunk_dt_s=self.contract.chunk_dt_s,
                at_s=(read + 0.5) / READS_A_STEP * self._frame_dt_s,
            )
            for read in range(self._frames * READS_A_STEP)
        ]
        means = np.array(sticks, np.float32).reshape(self._frames, READS_A_STEP, -1).mean(axis=1)
        clipped: FloatArray = np.clip(means, -1.0, 1.0)
        return clipped


class WorldModelDecider:
    """The world model itself, with the actions part of what it samples."""

    def __init__(self, sampler: Sampler, *, from_pixels: bool) -> None:
        """Choose what it looks at.

        Args:
            sampler: of the world model.
            from_pixels: its own frames, decoded and encoded again, and not their latents.
        """
        self.images = sampler.config.context_frames if from_pixels else 0
        self.contract = sampler.config.contract
        self._sampler = sampler

    def decide(self, seen: ObservationQueue, seed: int) -> FloatArray:
        """The actions of one sample; its latents are of no use to anybody."""
        if self.images:
            latents = self._sampler.encode(np.stack(seen.images))[None]
        else:
            latents = seen.latents()
        return self._sampler.sample(latents, seen.states(), None, seed=seed).actions
