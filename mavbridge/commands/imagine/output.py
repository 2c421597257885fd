"""What becomes of a rollout's segments: a video, its rows, a digest, and whoever looks on."""

import hashlib
from collections.abc import Callable
from typing import Protocol

import numpy as np

from mavbridge.commands.imagine.loop import Segment
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.records import ImageArray, RolloutFrame
from mavbridge.recording.rows import FrameRow


class OnFrame(Protocol):
    """Looks on; called in the video's order, by one thread."""

    def __call__(self, frame: RolloutFrame, rgb: ImageArray | None) -> None:
        """One frame [H, W, 3]; None where nothing is decoded for the video."""
        ...


class Output(Protocol):
    """Takes segments; used by the loop's thread."""

    def put(self, segment: Segment) -> None:
        """Take the next segment; may block.

        Raises:
            MavbridgeError: what came before could not be written.
        """
        ...

    def finish(self, on_wait: Callable[[], None]) -> None:
        """Everything to the disk, files closed.

        Args:
            on_wait: called now and then meanwhile.

        Raises:
            MavbridgeError: it could not all be written.
        """
        ...

    def close(self) -> None:
        """Leave things as they are, after an error; may be called twice."""
        ...

    @property
    def frames(self) -> int:
        """Frames that have left the decoder."""
        ...

    @property
    def frames_decoded(self) -> int:
        """Beside the loop's thread; what that decodes is in its meter."""
        ...

    @property
    def decode_queue(self) -> int:
        """Segments that wait to be decoded."""
        ...

    @property
    def writer_queue(self) -> int:
        """Frames that wait to be written."""
        ...

    @property
    def writer_pid(self) -> int | None:
        """The writer process, where there is one."""
        ...

    @property
    def sha256(self) -> str:
        """Of all frames so far, raw, in their order."""
        ...


def ignore(frame: RolloutFrame, rgb: ImageArray | None) -> None:
    """Nobody looks on."""


class FrameDigest:
    """SHA-256 of raw frames [H, W, 3] uint8, one after the other."""

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def add(self, rgb: ImageArray) -> None:
        """One more frame."""
        self._hash.update(np.ascontiguousarray(rgb).data)

    def hexdigest(self) -> str:
        """Of all so far."""
        return self._hash.hexdigest()


def frame_row(frame: RolloutFrame, clock: Clock) -> FrameRow:
    """What the video's writer wants to know: the frames follow each other evenly."""
    return FrameRow(
        frame_id=frame.number,
        captured_ns=round(frame.number * frame.frame_dt_s * NS_PER_S),
        ready_ns=clock.now_ns(),
    )
