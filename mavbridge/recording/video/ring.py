"""Shared memory with a fixed number of slots that passes frames from one process to another.

Messages over the pipe between the processes pass the slots on and order the accesses. A slot
belongs to the producer until ``Submit`` names it, and again from ``Written`` on.
"""

import mmap
import os
import socket
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mavbridge.core.records import CameraImage

MAX_SLOTS = 32
MIN_SLOTS = 4
MAX_BYTES = 32 << 20
"""Size limit of a ring with more than its least number of slots: some containers have only 64 MB of
shared memory."""


class RingShape(NamedTuple):
    """Layout of the memory, for the other process. Its file descriptor follows on the pipe."""

    slots: int
    height: int
    width: int
    is_depth: bool

    @property
    def frame(self) -> "np.dtype[np.void]":
        """Data type and axes of a frame."""
        kind, axes = (np.uint16, ()) if self.is_depth else (np.uint8, (3,))
        return np.dtype((kind, (self.height, self.width, *axes)))


def ring_shape(height: int, width: int, *, is_depth: bool = False) -> RingShape:
    """Return the layout for frames of this size."""
    slots = MAX_BYTES // RingShape(1, height, width, is_depth).frame.itemsize
    return RingShape(max(MIN_SLOTS, min(MAX_SLOTS, slots)), height, width, is_depth)


def allocate(shape: RingShape) -> int:
    """Return the descriptor of a file without a name; raise OSError if there is no memory left.

    The memory is freed with its last descriptor, even if both processes are killed. Its pages are
    allocated now: a page that is unavailable at its first write ends the process.
    """
    size_bytes = shape.slots * shape.frame.itemsize
    shared = Path("/dev/shm")  # noqa: S108 - the system's place for shared memory
    has_shared = shared.is_dir()
    with tempfile.TemporaryFile(dir=shared if has_shared else None) as file:
        if has_shared:
            os.posix_fallocate(file.fileno(), 0, size_bytes)
        else:
            file.truncate(size_bytes)
        return os.dup(file.fileno())


def send_descriptor(pipe: "Connection[Any, Any]", descriptor: int) -> None:
    """Send a file descriptor over a duplex pipe; raise OSError if the receiver is gone.

    Never waits: since Python 3.14 ``multiprocessing.reduction.send_handle`` waits for an answer.
    """
    with socket.fromfd(pipe.fileno(), socket.AF_UNIX, socket.SOCK_STREAM) as carrier:
        socket.send_fds(carrier, [b"F"], [descriptor])


def receive_descriptor(pipe: "Connection[Any, Any]") -> int:
    """Return the file descriptor of ``send_descriptor``; raise EOFError if the sender is gone."""
    with socket.fromfd(pipe.fileno(), socket.AF_UNIX, socket.SOCK_STREAM) as carrier:
        _, descriptors, _, _ = socket.recv_fds(carrier, 1, 1)
    if not descriptors:
        raise EOFError
    return descriptors[0]


class FrameRing:
    """Slots of one frame each, mapped."""

    def __init__(self, shape: RingShape, descriptor: int) -> None:
        """Map the memory, and close the descriptor."""
        self.shape = shape
        try:
            self._memory = mmap.mmap(descriptor, shape.slots * shape.frame.itemsize)
        finally:
            os.close(descriptor)
        self._frames: CameraImage | None = np.ndarray(shape.slots, shape.frame, self._memory)

    def slot(self, index: int) -> CameraImage:
        """Return a view of one slot. Do not keep it beyond ``close``."""
        if self._frames is None:
            raise ValueError("the ring is closed")
        frame: CameraImage = self._frames[index]
        return frame

    def close(self) -> None:
        """Unmap the memory. Can be called twice."""
        self._frames = None
        self._memory.close()
