"""Protocols that the control loops depend on."""

from typing import Protocol

from mavbridge.core.records import Event, Frame


class Camera(Protocol):
    """Video source, opened by its constructor and used by one thread."""

    @property
    def dropped_frames(self) -> int:
        """Number of frames that were delivered and not read, since the source was opened."""

    def read(self, timeout_ns: int) -> Frame | None:
        """Return the newest frame not returned before; None if none arrives within the timeout.

        Raises:
            CameraError: the source has died and will not recover by itself.
        """

    def close(self) -> None:
        """Free the source and join its thread. May be called twice."""


class TickSink(Protocol):
    """Receiver of events. Must never block and never raise."""

    def emit(self, event: Event) -> None:
        """Take the event, or drop and count it."""
