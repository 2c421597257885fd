"""The guard and the policy loop in simulated time: the classes of a real flight, run as events."""

from collections.abc import Callable
from functools import partial

from mavbridge.flight.policy_loop import PolicyLoop
from mavbridge.flight.telemetry_cache import TelemetryCache
from mavbridge.guard.loop import GuardLoop
from mavbridge.guard.wire import ToGuard, decode_from_guard, encode_to_guard
from mavbridge.simulation.clock import AheadClock, SteppedClock
from mavbridge.simulation.network import DelayedChannel


class MemoryPort:
    """A ``guard.channel.Port`` over two channels whose messages arrive after their delay."""

    def __init__(self, *, outgoing: DelayedChannel, incoming: DelayedChannel) -> None:
        self._outgoing = outgoing
        self._incoming = incoming
        self.is_closed = False

    def send(self, message: bytes, fd: int | None = None) -> bool:
        """Send one message; always succeeds."""
        self._outgoing.send(message)
        return True

    def receive(self) -> list[bytes]:
        """Messages that have arrived."""
        return [data for _, data in self._incoming.receive()]


class GuardStepper:
    """Steps the guard whenever something arrives, and at its own grid."""

    def __init__(self, clock: SteppedClock, loop: GuardLoop) -> None:
        self._clock = clock
        self._loop = loop
        self._due_ns = 0
        clock.schedule(clock.now_ns(), self.step)

    def step(self) -> None:
        """One pass of the guard, now."""
        if self._loop.is_done:
            return
        due_ns = self._loop.step()
        if due_ns != self._due_ns:
            self._due_ns = due_ns
            self._clock.schedule(due_ns, self._step_if_due)

    def _step_if_due(self) -> None:
        """Woken by the grid; an earlier step may have moved the next one."""
        if self._clock.now_ns() >= self._due_ns:
            self.step()


class PolicyStepper:
    """Runs the policy loop whenever it is idle and an attitude has arrived that it has not used."""

    def __init__(
        self,
        world: SteppedClock,
        clock: AheadClock,
        port: MemoryPort,
        loop: PolicyLoop,
        view: TelemetryCache,
    ) -> None:
        self._world = world
        self._clock = clock
        self._port = port
        self._loop = loop
        self._view = view
        self._is_busy = False

    def receive(self) -> None:
        """Take the guard's messages that have arrived, and solve if there is something new."""
        for data in self._port.receive():
            self._view.receive(decode_from_guard(data))
        self._solve()

    def _solve(self) -> None:
        if self._is_busy or not self._loop.has_news:
            return
        self._is_busy = True
        self._loop.step()
        busy_ns, self._clock.ahead_ns = self._clock.ahead_ns, 0
        self._world.schedule(self._world.now_ns() + busy_ns, self._end)

    def _end(self) -> None:
        self._is_busy = False
        self._solve()


def sender(world: SteppedClock, clock: AheadClock, port: MemoryPort) -> Callable[[ToGuard], object]:
    """Hands messages to the guard at the time at which ``clock`` says that they were made."""

    def send(message: ToGuard) -> None:
        data = encode_to_guard(message)
        world.schedule(clock.now_ns(), partial(port.send, data))

    return send
