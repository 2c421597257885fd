"""Interfaces of what the loops are connected to."""

from typing import Protocol

from mavbridge.core.records import Event, Frame
from mavbridge.core.vehicle import Decision, LinkSnapshot, Sticks


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


class Link(Protocol):
    """The connection to one vehicle; used by the action loop's thread alone."""

    def poll(self) -> LinkSnapshot:
        """Receive everything that has arrived; never blocks."""

    def service(self) -> None:
        """Send what is due besides sticks (heartbeat, handshake, requests); called after them."""

    def wait_for_attitude(self, *, newer_than_ns: int, until_ns: int) -> int:
        """Receive until an attitude newer than ``newer_than_ns`` arrives, or until ``until_ns``.

        Returns the arrival time of the newest attitude, 0 before the first.
        """

    def send(self, decision: Decision) -> Sticks | None:
        """Send the decision; returns the sticks as rounded and sent, None when released."""

    def hand_back(self) -> None:
        """Repeat the release at the end of a flight, as packets may be lost; takes 0.5 s."""

    def set_mode(self, mode: str) -> None:
        """Ask for a flight mode (rate-limited; a later heartbeat shows the result)."""

    def arm(self) -> None:
        """Ask to arm (rate-limited; a later heartbeat shows the result)."""


class TickSink(Protocol):
    """A receiver of ticks; must never block and never raise."""

    def emit(self, event: Event) -> None:
        """Take the event, or drop and count it."""
