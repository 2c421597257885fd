"""Connections of vehicle, guard and flight process in simulated time, and what steps the last two.

Datagrams arrive whole and in order, after a delay. The classes are those of a real flight, run as
events.
"""

from collections import deque
from collections.abc import Callable, Iterator
from functools import partial

from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.wire import ToGuard, decode_from_guard, encode
from mavbridge.mavlink.transport.connection import Address, Received, Transport
from mavbridge.simulation.clock import AheadClock, SteppedClock, Stepper

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


class MemoryPort:
    """``guard.channel.Port`` over two delayed channels."""

    def __init__(self, *, outgoing: DelayedChannel, incoming: DelayedChannel) -> None:
        self._outgoing = outgoing
        self._incoming = incoming
        self.is_closed = False

    def send(self, message: bytes, fd: int | None = None) -> bool:
        """Send one message; always succeeds."""
        self._outgoing.send(message)
        return True

    def receive(self) -> list[bytes]:
        """Return the messages that have arrived."""
        return [data for _, data in self._incoming.receive()]


class GuardStepper:
    """Steps the guard at each arrival and at each point of its grid."""

    def __init__(self, clock: SteppedClock, loop: GuardLoop) -> None:
        self._clock = clock
        self._loop = loop
        self._due_ns = 0
        clock.schedule(clock.now_ns(), self.step)

    def step(self) -> None:
        """Run one pass of the guard now."""
        if self._loop.is_done:
            return
        due_ns = self._loop.step()
        if due_ns != self._due_ns:
            self._due_ns = due_ns
            self._clock.schedule(due_ns, self._step_if_due)

    def _step_if_due(self) -> None:
        """Run a pass at a grid point, unless an earlier step has moved the next point."""
        if self._clock.now_ns() >= self._due_ns:
            self.step()


def flight_process(
    world: SteppedClock,
    clock: AheadClock,
    port: MemoryPort,
    loop: PolicyLoop,
    view: TelemetryCache,
) -> Callable[[], None]:
    """Return a function that takes the guard's arrived messages, and solves if there is news."""
    stepper = Stepper(world, clock, lambda: loop.has_news, loop.step)

    def receive() -> None:
        for data in port.receive():
            view.receive(decode_from_guard(data))
        stepper.run()

    return receive


def sender(world: SteppedClock, clock: AheadClock, port: MemoryPort) -> Callable[[ToGuard], object]:
    """Return a function that sends messages to the guard at the time on ``clock``."""

    def send(message: ToGuard) -> None:
        data = encode(message)
        world.schedule(clock.now_ns(), partial(port.send, data))

    return send
