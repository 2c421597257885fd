"""In-memory network between two ends: datagrams arrive whole and in order, after a delay."""

from collections import deque
from collections.abc import Callable, Iterator

from mavbridge.mavlink.transport.connection import Address, Received, Transport
from mavbridge.simulation.clock import SteppedClock

VEHICLE: Address = ("sitl", 1)


class DelayedChannel:
    """One direction of the network, or of the channel between two processes."""

    def __init__(
        self,
        clock: SteppedClock,
        delays_ns: Iterator[int],
        stalled_until_ns: Callable[[int], int] = int,
    ) -> None:
        """Create an empty channel. ``stalled_until_ns`` maps an arrival to the end of a stall at
        that time; by default there are no stalls."""
        self._clock = clock
        self._delays_ns = delays_ns
        self._stalled_until_ns = stalled_until_ns
        self._in_flight: deque[tuple[int, bytes]] = deque()
        self._last_arrival_ns = 0
        self.on_arrival: Callable[[], None] | None = None
        """Called at each arrival."""

    def send(self, data: bytes) -> None:
        """Send a datagram; it arrives after its delay and never before an earlier one."""
        arrival_ns = self._stalled_until_ns(self._clock.now_ns() + next(self._delays_ns))
        self._last_arrival_ns = max(self._last_arrival_ns, arrival_ns)
        self._in_flight.append((self._last_arrival_ns, data))
        if self.on_arrival is not None:
            self._clock.schedule(self._last_arrival_ns, self.on_arrival)

    def receive(self) -> Iterator[tuple[int, bytes]]:
        """Yield the arrival stamp [ns] and bytes of every datagram that has arrived."""
        now_ns = self._clock.now_ns()
        while self._in_flight and self._in_flight[0][0] <= now_ns:
            yield self._in_flight.popleft()


class MemoryTransport(Transport):
    """The bridge's end of the network, with exact arrival stamps."""

    def __init__(self, *, to_vehicle: DelayedChannel, from_vehicle: DelayedChannel) -> None:
        self._to_vehicle = to_vehicle
        self._from_vehicle = from_vehicle

    def drain(self) -> Iterator[Received]:
        """Yield every datagram that has arrived."""
        for arrived_ns, data in self._from_vehicle.receive():
            yield Received(data, arrived_ns, VEHICLE)

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        """Send one packet; always succeeds."""
        self._to_vehicle.send(data)
        return True
