"""Waiting times that all sources share, and the wait for a source's first frame."""

from collections.abc import Callable
from typing import Protocol

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.errors import CameraError
from mavbridge.core.ports import Camera
from mavbridge.core.records import Frame

REOPENED_NS = 10 * NS_PER_S
"""Limit for the first frame of a source that was opened again: exposure control, negotiation."""
STALL_NS = 2 * NS_PER_S
"""Limit for every other frame."""


class LiveCamera(Camera, Protocol):
    """A camera that may begin to deliver long after it was opened.

    Before its first frame ``read`` only raises CameraError for what waiting cannot mend.
    """

    @property
    def waiting_reason(self) -> str:
        """Why there is no frame yet, as far as it is known."""


def wait_for_first_frame(
    camera: LiveCamera, *, clock: Clock, timeout_s: float, report: Callable[[str], None]
) -> Frame:
    """Return the first frame; every second until then ``report`` gets a line of a countdown.

    The reason for the wait is reported when it changes. Raises CameraError if none comes in time,
    or as ``read`` does.
    """
    deadline_ns = clock.now_ns() + round(timeout_s * NS_PER_S)
    told: str | None = None
    while (left_ns := deadline_ns - clock.now_ns()) > 0:
        if (frame := camera.read(left_ns % NS_PER_S or NS_PER_S)) is not None:
            return frame
        left_s = round((deadline_ns - clock.now_ns()) / NS_PER_S)
        if left_s > 0:
            reason = camera.waiting_reason
            report(
                f"waiting for the camera: {left_s} s left{'' if told == reason else f' ({reason})'}"
            )
            told = reason
    raise CameraError(
        f"the camera has delivered no frame within {timeout_s:g} s (link.camera_timeout): "
        f"{camera.waiting_reason}"
    )


def wait_until_due(clock: Clock, due_ns: int, timeout_ns: int) -> bool:
    """Sleep until ``due_ns``, but no longer than the timeout; True if that time has come."""
    deadline_ns = clock.now_ns() + timeout_ns
    clock.sleep_until_ns(min(due_ns, deadline_ns))
    return due_ns <= deadline_ns
