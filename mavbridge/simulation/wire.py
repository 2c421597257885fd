"""A network of two ends in memory: datagrams arrive, whole and in order, after their delay."""

from collections import deque
from collections.abc import Iterator

from mavbridge.mavlink.transport.sockets import Address, Chunk
from mavbridge.simulation.clock import SteppedClock

VEHICLE: Address = ("sitl", 1)
"""Where the vehicle's datagrams come from."""


class Path:
    """One direction."""

    def __init__(self, clock: SteppedClock, delays_ns: Iterator[int]) -> None:
        self._clock = clock
        self._delays_ns = delays_ns
        self._under_way: deque[tuple[int, bytes]] = deque()
        self._last_ns = 0

    def send(self, data: bytes) -> None:
        """Put a datagram on its way; none overtakes another."""
        self._last_ns = max(self._last_ns, self._clock.now_ns() + next(self._delays_ns))
        self._under_way.append((self._last_ns, data))

    def arrived(self) -> Iterator[tuple[int, bytes]]:
        """Arrival stamp and datagram of all that is there now."""
        now_ns = self._clock.now_ns()
        while self._under_way and self._under_way[0][0] <= now_ns:
            yield self._under_way.popleft()

    @property
    def next_arrival_ns(self) -> int | None:
        """Of the oldest datagram that nobody has taken; None = nothing is under way."""
        return self._under_way[0][0] if self._under_way else None


class MemoryTransport:
    """The bridge's end: a ``mavlink.transport.Transport`` whose stamps are exact arrivals."""

    def __init__(self, clock: SteppedClock, *, to_vehicle: Path, from_vehicle: Path) -> None:
        self._clock = clock
        self._to_vehicle = to_vehicle
        self._from_vehicle = from_vehicle

    def open(self) -> None:
        """Nothing to acquire."""

    def drain(self) -> Iterator[Chunk]:
        """Datagrams with their arrival stamps."""
        for arrived_ns, data in self._from_vehicle.arrived():
            yield Chunk(data, arrived_ns, VEHICLE)

    def wait(self, until_ns: int) -> None:
        """Let time pass until something has arrived, or until then.

        What is sent while time passes may arrive within it, so it passes from event to event.
        """
        while (now_ns := self._clock.now_ns()) < until_ns:
            arrival_ns, event_ns = self._from_vehicle.next_arrival_ns, self._clock.next_event_ns
            if arrival_ns is not None and arrival_ns <= now_ns:
                return
            stops = [stop for stop in (arrival_ns, event_ns) if stop is not None]
            self._clock.sleep_until_ns(min([until_ns, *stops]))

    def answer_to(self, sender: Address | None) -> None:
        """There is one vehicle."""

    def send(self, data: bytes) -> bool:
        """Put one packet on its way."""
        self._to_vehicle.send(data)
        return True

    def close(self) -> None:
        """Nothing to give back."""
