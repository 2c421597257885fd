"""Guard and policy loop in simulated time: the classes of a real flight, run as events."""

from collections.abc import Callable
from functools import partial

from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.wire import ToGuard, decode_from_guard, encode_to_guard
from mavbridge.simulation.clock import AheadClock, SteppedClock, Stepper
from mavbridge.simulation.network import DelayedChannel


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
        data = encode_to_guard(message)
        world.schedule(clock.now_ns(), partial(port.send, data))

    return send
