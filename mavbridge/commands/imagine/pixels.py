"""Latents to images beside the loop: in its thread on a CPU, on a stream of its own on a GPU."""

from collections import deque
from collections.abc import Iterator
from typing import Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mavbridge.core.records import ImageArray
from policy.world_model.model import WorldModel

PINNED_FRAMES = 4
"""Frames that may be on their way from the GPU at a time."""


class Latents:
    """Latents of frames to decode later, and what on their device must have happened before."""

    def __init__(self, values: Tensor) -> None:
        """To be made in the thread, and on the stream, that made the values [N, C, h, w]."""
        self.values = values
        self.ready: torch.cuda.Event | None = None
        if values.is_cuda:
            self.ready = torch.cuda.Event()  # type: ignore[no-untyped-call]
            self.ready.record(torch.cuda.current_stream(values.device))


class FrameSource(Protocol):
    """Decodes; used by one thread."""

    def frames(self, latents: Latents) -> Iterator[ImageArray]:
        """Images [H, W, 3] in order, each to be used before the next is asked for."""
        ...


def make_frame_source(model: WorldModel) -> FrameSource:
    """What suits the device of the model."""
    device = next(model.parameters()).device
    return _StreamSource(model, device) if device.type == "cuda" else _PlainSource(model)


class _PlainSource:
    """One frame at a time: the loop wants the processor, too."""

    def __init__(self, model: WorldModel) -> None:
        self._model = model

    def frames(self, latents: Latents) -> Iterator[ImageArray]:
        for row in range(len(latents.values)):
            with torch.inference_mode():
                pixels = self._model.decode(latents.values[row : row + 1])
            yield pixels[0].cpu().numpy()


class _StreamSource:
    """A CUDA stream beside the sampler's; frames come back through a ring of pinned memory."""

    def __init__(self, model: WorldModel, device: torch.device) -> None:
        self._model = model
        self._stream = torch.cuda.Stream(device)  # type: ignore[no-untyped-call]
        size = model.config.image_size
        ring = torch.empty(PINNED_FRAMES, size, size, 3, dtype=torch.uint8, pin_memory=True)
        self._slots = [ring[k] for k in range(PINNED_FRAMES)]
        self._views: list[NDArray[np.uint8]] = [slot.numpy() for slot in self._slots]

    def frames(self, latents: Latents) -> Iterator[ImageArray]:
        """No more frames are launched than there are slots; a slot is free once it was used."""
        under_way: deque[tuple[int, torch.cuda.Event]] = deque()
        if latents.ready is not None:
            self._stream.wait_event(latents.ready)
        # Freed by the loop's stream, the memory must not be given away before this one is done.
        latents.values.record_stream(self._stream)
        for row in range(len(latents.values)):
            if len(under_way) == PINNED_FRAMES:
                yield self._arrived(*under_way.popleft())
            slot = row % PINNED_FRAMES
            under_way.append((slot, self._launch(latents.values[row : row + 1], slot)))
        while under_way:
            yield self._arrived(*under_way.popleft())

    def _launch(self, latent: Tensor, slot: int) -> torch.cuda.Event:
        with torch.inference_mode(), torch.cuda.stream(self._stream):
            pixels = self._model.decode(latent)
            self._slots[slot].copy_(pixels[0], non_blocking=True)
            event = torch.cuda.Event()  # type: ignore[no-untyped-call]
            event.record(self._stream)
        return event

    def _arrived(self, slot: int, event: torch.cuda.Event) -> ImageArray:
        event.synchronize()
        return self._views[slot]
