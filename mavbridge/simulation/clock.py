"""Simulated time, which advances when a loop waits and runs the events on its way."""

import heapq
from collections.abc import Callable
from itertools import count

from mavbridge.core.clock import NS_PER_S

START_NS = 1_000 * NS_PER_S
"""Start of simulated time; not zero, which some stamps use for "never"."""


class SteppedClock:
    """``Clock`` with a queue of events, for one thread.

    Only the caller waits; the rest of the simulated world consists of events. Each event runs at
    its time and takes no time. Events of equal time run in the order of scheduling.
    """

    def __init__(self, start_ns: int = START_NS) -> None:
        self._now_ns = start_ns
        self._events: list[tuple[int, int, Callable[[], object]]] = []
        self._order = count()
        self._is_in_event = False

    def now_ns(self) -> int:
        """Return the simulated time."""
        return self._now_ns

    def schedule(self, at_ns: int, event: Callable[[], object]) -> None:
        """Run ``event`` at ``at_ns``; if that has passed, as soon as time advances."""
        heapq.heappush(self._events, (at_ns, next(self._order), event))

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Advance time to ``deadline_ns``, and run the events due by then.

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
    """``Clock`` of a loop that runs as an event: simulated time plus the loop's working time.

    The vision loop encodes an image within one event, but the result must exist only later: its
    stamps come from this clock, and its publication is scheduled for them.
    """

    def __init__(self, world: SteppedClock) -> None:
        self._world = world
        self.ahead_ns = 0

    def now_ns(self) -> int:
        """Return the simulated time plus the working time."""
        return self._world.now_ns() + self.ahead_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Count the time until ``deadline_ns`` as working time."""
        self.ahead_ns = max(self.ahead_ns, deadline_ns - self._world.now_ns())


class Stepper:
    """Runs a step of a loop, as an event, whenever the loop is idle and has work."""

    def __init__(
        self,
        world: SteppedClock,
        clock: AheadClock,
        has_work: Callable[[], bool],
        step: Callable[[], object],
    ) -> None:
        """``clock`` is that of the loop: it tells how long a step takes."""
        self._world = world
        self._clock = clock
        self._has_work = has_work
        self._step = step
        self._is_busy = False

    def run(self) -> None:
        """Step until there is no work or a step takes time; go on when that has passed."""
        while not self._is_busy and self._has_work():
            self._step()
            busy_ns, self._clock.ahead_ns = self._clock.ahead_ns, 0
            if busy_ns:
                self._is_busy = True
                self._world.schedule(self._world.now_ns() + busy_ns, self._end)

    def _end(self) -> None:
        self._is_busy = False
        self.run()
