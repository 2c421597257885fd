"""The few Protocols that the loops need."""

from typing import Protocol

from mavbridge.core.records import Decision, Event, Frame, LinkSnapshot, Packet, Sticks


class Camera(Protocol):
    """A video source; opened by its constructor, used by one thread."""

    @property
    def dropped_frames(self) -> int:
        """Frames that the source has delivered but that were never read, since it was opened."""
        ...

    def read(self, timeout_ns: int) -> Frame | None:
        """Newest frame that was not returned before; None if there is none within the timeout.

        Raises:
            CameraError: the source has failed for good.
        """
        ...

    def close(self) -> None:
        """Free the source; joins its thread. May be called twice."""
        ...


class Link(Protocol):
    """The vehicle's end of the action loop; used by the action loop's thread alone."""

    def poll(self) -> LinkSnapshot:
        """Receive everything that has arrived; never blocks."""
        ...

    def service(self) -> None:
        """Send the heartbeat, handshake and requests that are due; called after the sticks."""
        ...

    def wait_for_attitude(self, *, newer_than_ns: int, until_ns: int) -> int:
        """Receive until an attitude newer than ``newer_than_ns`` has come, or until the deadline.

        Returns the arrival of the newest attitude, 0 before the first.
        """
        ...

    def send(self, decision: Decision) -> Sticks | None:
        """Send the decision; returns the sticks that were really sent, None on release."""
        ...

    def hand_back(self) -> None:
        """Send the remaining releases at the end of a flight; takes up to half a second."""
        ...

    def force_release(self) -> None:
        """From any thread: release the sticks now and block all other sends."""
        ...

    def set_mode(self, mode: str) -> None:
        """Request a flight mode (rate-limited; the next heartbeat shows the result)."""
        ...

    def arm(self) -> None:
        """Request arming (rate-limited; the next heartbeat shows the result)."""
        ...

    def close(self) -> None:
        """Free the socket or port."""
        ...


class PacketSource(Protocol):
    """Packets of the link for a recorder; drained by one thread."""

    @property
    def dropped(self) -> int:
        """Packets that were not drained in time."""
        ...

    def drain(self) -> list[Packet]:
        """Packets of both directions since the last call."""
        ...


class TickSink(Protocol):
    """Where ticks go; must never block and never raise."""

    def emit(self, event: Event) -> None:
        """Take the event, or drop and count it."""
        ...
