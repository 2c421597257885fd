"""The few Protocols that the loops need."""

from typing import Protocol

from mavbridge.core.records import Decision, Event, Frame, LinkSnapshot, Packet, Sticks


class Camera(Protocol):
    """A video source; opened by its constructor, used by one thread."""

    @property
    def dropped_frames(self) -> int:
        """Frames that the source delivered and nobody read, since it was opened."""
        ...

    def read(self, timeout_ns: int) -> Frame | None:
        """Newest frame that was not returned before; None if none comes within the timeout.

        Raises:
            CameraError: the source has died and will not come back by itself.
        """
        ...

    def close(self) -> None:
        """Free the source; joins its thread. May be called twice."""
        ...


class Link(Protocol):
    """The vehicle's end of the action loop; used by the action loop's thread alone."""

    def poll(self) -> LinkSnapshot:
        """Take in all that has arrived; never blocks."""
        ...

    def service(self) -> None:
        """Heartbeat, handshake and requests that are due; called when the sticks have left."""
        ...

    def wait_for_attitude(self, *, newer_than_ns: int, until_ns: int) -> int:
        """Take in what arrives until an attitude newer than that has come, or until the time.

        Returns the arrival of the newest attitude, 0 before the first.
        """
        ...

    def send(self, decision: Decision) -> Sticks | None:
        """Put the decision on the wire; returns the sticks that really left, None on release."""
        ...

    def hand_back(self) -> None:
        """Finish giving the sticks back; takes up to half a second, at the end of a flight."""
        ...

    def force_release(self) -> None:
        """From any thread: give the sticks back now, and let nothing else leave any more."""
        ...

    def set_mode(self, mode: str) -> None:
        """Ask for a flight mode (rate-limited; the next heartbeat tells)."""
        ...

    def arm(self) -> None:
        """Ask to arm (rate-limited; the next heartbeat tells)."""
        ...

    def close(self) -> None:
        """Free the socket or port."""
        ...


class PacketSource(Protocol):
    """What goes over the link, for a recorder; drained by one thread."""

    @property
    def dropped(self) -> int:
        """Pieces that nobody drained in time."""
        ...

    def drain(self) -> list[Packet]:
        """Packets of both directions since the last call."""
        ...


class TickSink(Protocol):
    """Where ticks go; must never block and never raise."""

    def emit(self, event: Event) -> None:
        """Take the event, or drop and count it."""
        ...
