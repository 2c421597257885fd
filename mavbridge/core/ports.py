"""Interfaces of what the loops are connected to."""

from typing import Protocol

from mavbridge.core.records import Event, Frame


class Camera(Protocol):
    """A video source; opened by its constructor, used by one thread."""

    @property
    def dropped_frames(self) -> int:
        """Frames that the source delivered and nobody read, since it was opened."""

    def read(self, timeout_ns: int) -> Frame | None:
        """Newest frame that was not returned before; None if none comes within the timeout.

        Raises:
            CameraError: the source has died and will not come back by itself.
        """

    def close(self) -> None:
        """Free the source; joins its thread. May be called twice."""


class TickSink(Protocol):
    """A receiver of ticks; must never block and never raise."""

    def emit(self, event: Event) -> None:
        """Take the event, or drop and count it."""
