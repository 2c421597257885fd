"""Simulated time: it passes when somebody waits, and then what is due in the world happens."""

import heapq
from collections.abc import Callable
from itertools import count

from mavbridge.core.clock import NS_PER_S

START_NS = 1_000 * NS_PER_S
"""Away from zero, which some stamps use for "never"."""


class SteppedClock:
    """A ``Clock`` with a queue of events; one thread, always the same order.

    Only the action loop waits. Everything else in the world is an event: it runs at its time, in
    the order of scheduling where times are equal, and takes no time itself.
    """

    def __init__(self, start_ns: int = START_NS) -> None:
        self._now_ns = start_ns
        self._events: list[tuple[int, int, Callable[[], None]]] = []
        self._order = count()
        self._is_in_event = False

    def now_ns(self) -> int:
        """Simulated time; within an event, its time."""
        return self._now_ns

    @property
    def next_event_ns(self) -> int | None:
        """When the next event is due; None = nothing is planned."""
        return self._events[0][0] if self._events else None

    def schedule(self, at_ns: int, event: Callable[[], None]) -> None:
        """Run ``event`` at ``at_ns``, or as soon as time passes if that is over."""
        heapq.heappush(self._events, (at_ns, next(self._order), event))

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Let time pass to ``deadline_ns``, events at that very time included."""
        if self._is_in_event:
            raise RuntimeError("an event must not wait: it would reorder the world")
        self._is_in_event = True
        try:
            while self._events and self._events[0][0] <= deadline_ns:
                at_ns, _, event = heapq.heappop(self._events)
                self._now_ns = max(self._now_ns, at_ns)
                event()
        finally:
            self._is_in_event = False
        self._now_ns = max(self._now_ns, deadline_ns)


class AheadClock:
    """The clock of a loop that runs as an event: ahead of the world by the time that it has worked.

    The vision loop encodes an image in one go, and yet the result must exist only later; its stamps
    come from here, and what it publishes is scheduled for them.
    """

    def __init__(self, world: SteppedClock) -> None:
        self._world = world
        self.ahead_ns = 0

    def now_ns(self) -> int:
        """The world's time and the work since."""
        return self._world.now_ns() + self.ahead_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Be ahead until then."""
        self.ahead_ns = max(self.ahead_ns, deadline_ns - self._world.now_ns())
