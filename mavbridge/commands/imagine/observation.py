"""What a decider and the simulator may see: the last few steps, and no more."""

from collections import deque

import numpy as np
import torch
from torch import Tensor

from mavbridge.commands.imagine.start import Start
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.records import FloatArray, ImageArray, Sticks
from mavbridge.flight.history import SentHistory
from policy.contract import Contract


class ObservationQueue:
    """The newest latents, states and images, oldest first, and the sticks that were executed.

    Images are pushed by whoever decodes them, one by one: there may be fewer than steps.
    """

    def __init__(
        self, start: Start, latents: Tensor, *, frame_dt_s: float, images: int, contract: Contract
    ) -> None:
        """Begin with what was really seen.

        Args:
            start: the observed past.
            latents: [context_frames, C, h, w] of its images.
            frame_dt_s: between two steps.
            images: how many the decider looks at.
            contract: of the decider: length and spacing of its history.
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
        """One executed step: the sticks that were held, and what came of them.

        Args:
            latent: [C, h, w]
            state: [13]
            action: [4]
        """
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
