"""Shared memory with a fixed number of slots that passes frames from one process to another.

Messages over the pipe between the processes pass the slots on and order the accesses. A slot
belongs to the producer until ``Submit`` names it, and again from ``Written`` on.
"""

import os
from multiprocessing.shared_memory import SharedMemory
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mavbridge.core.records import CameraImage

MAX_SLOTS = 32
MIN_SLOTS = 4
MAX_BYTES = 32 << 20
"""Size limit of a ring with more than its least number of slots: some containers have only 64 MB of
shared memory."""


class RingShape(NamedTuple):
    """Name and layout of the memory, for the other process."""

    name: str
    slots: int
    height: int
    width: int
    is_depth: bool = False

    @property
    def frame(self) -> "np.dtype[np.void]":
        """Data type and axes of a frame."""
        each = (np.uint16, ()) if self.is_depth else (np.uint8, (3,))
        return np.dtype((each[0], (self.height, self.width, *each[1])))


class FrameRing:
    """Slots of one frame each, mapped."""

    def __init__(self, memory: SharedMemory, shape: RingShape) -> None:
        """Call ``create`` in the producer and ``attach`` in the consumer, not this."""
        self.shape = shape
        self._memory = memory
        self._is_linked = False
        self._frames: CameraImage | None = np.ndarray(shape.slots, shape.frame, memory.buf)

    @classmethod
    def create(cls, height: int, width: int, *, is_depth: bool = False) -> "FrameRing":
        """Allocate the memory in the producer; raise OSError if there is not enough."""
        frame_bytes = height * width * (2 if is_depth else 3)
        slots = max(MIN_SLOTS, min(MAX_SLOTS, MAX_BYTES // frame_bytes))
        memory = SharedMemory(create=True, size=slots * frame_bytes)
        # Allocate the pages now: a page that is unavailable at its first write ends the process.
        path = Path("/dev/shm") / memory.name.lstrip("/")  # noqa: S108 - where Linux keeps them
        try:
            if path.exists():
                with path.open("r+b") as file:
                    os.posix_fallocate(file.fileno(), 0, memory.size)
        except OSError:
            memory.close()
            memory.unlink()
            raise
        ring = cls(memory, RingShape(memory.name, slots, height, width, is_depth))
        ring._is_linked = True
        return ring

    @classmethod
    def attach(cls, shape: RingShape) -> "FrameRing":
        """Map the memory in the consumer; raise OSError if it is gone."""
        return cls(SharedMemory(name=shape.name), shape)

    def slot(self, index: int) -> CameraImage:
        """Return a view of one slot. Do not keep it beyond ``close``."""
        if self._frames is None:
            raise ValueError("the ring is closed")
        frame: CameraImage = self._frames[index]
        return frame

    def unlink(self) -> None:
        """Remove the name, in the producer: the memory is freed even if both are killed."""
        if self._is_linked:
            self._is_linked = False
            self._memory.unlink()

    def close(self) -> None:
        """Unmap the memory and, in the producer, remove the name. Can be called twice."""
        self._frames = None
        self._memory.close()
        self.unlink()
