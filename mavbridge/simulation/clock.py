"""Simulated time: it passes when a loop waits, and events run as it passes them."""

import heapq
from collections.abc import Callable
from itertools import count

from mavbridge.core.clock import NS_PER_S

START_NS = 1_000 * NS_PER_S
"""Away from zero, which some stamps use for "never"."""


class SteppedClock:
    """A ``Clock`` with a queue of events, for one thread.

    Whoever flies waits; all of the simulated world is events: each runs at its time, takes no time
    itself, and events of equal time run in the order of scheduling.
    """

    def __init__(self, start_ns: int = START_NS) -> None:
        self._now_ns = start_ns
        self._events: list[tuple[int, int, Callable[[], object]]] = []
        self._order = count()
        self._is_in_event = False

    def now_ns(self) -> int:
        """Simulated time."""
        return self._now_ns

    @property
    def next_event_ns(self) -> int | None:
        """When the next event is due; None = no event is scheduled."""
        return self._events[0][0] if self._events else None

    def schedule(self, at_ns: int, event: Callable[[], object]) -> None:
        """Run ``event`` at ``at_ns``, or as soon as time passes if that is already over."""
        heapq.heappush(self._events, (at_ns, next(self._order), event))

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Let time pass to ``deadline_ns``, and run the events due by then.

        Raises:
            RuntimeError: called from within an event, with a deadline that has not passed.
        """
        if self._is_in_event and deadline_ns <= self._now_ns:
            return
        if self._is_in_event:
            raise RuntimeError("an event must not wait: later events would run before its end")
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
    """The ``Clock`` of a loop that runs as an event: simulated time plus the time it has worked.

    The vision loop encodes an image within one event, yet the result must exist only later: its
    stamps come from this clock, and what it publishes is scheduled for them.
    """

    def __init__(self, world: SteppedClock) -> None:
        self._world = world
        self.ahead_ns = 0

    def now_ns(self) -> int:
        """Simulated time plus the time worked."""
        return self._world.now_ns() + self.ahead_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Count the time until ``deadline_ns`` as worked."""
        self.ahead_ns = max(self.ahead_ns, deadline_ns - self._world.now_ns())
