"""Watches the action thread during a flight and says whose fault each missed slot was."""

import gc
from collections.abc import Callable
from pathlib import Path

from mavbridge.commands.bench.meter import stolen_ns
from mavbridge.core.clock import Clock
from mavbridge.core.records import Event, Tick
from mavbridge.observe.attribution import CAUSES, Cause, Counters, Lateness, attribute

_SCHEDSTAT = Path("/proc/thread-self/schedstat")
"""Of the thread that reads it: ns on a processor, ns in a run queue, turns (sched-stats.rst)."""


def read_counters(gc_ns: int) -> Counters:
    """All counters now; to be called by the action thread."""
    return Counters(stolen_ns=stolen_ns(), runnable_ns=_runnable_ns(), gc_ns=gc_ns)


def _runnable_ns() -> int | None:
    try:
        return int(_SCHEDSTAT.read_text().split()[1])
    except (OSError, LookupError, ValueError):
        return None


class GcWatch:
    """Adds up the time inside the garbage collector, while it is installed."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._start_ns = 0
        self.total_ns = 0

    def __enter__(self) -> "GcWatch":
        gc.callbacks.append(self._on_gc)
        return self

    def __exit__(self, *_: object) -> None:
        gc.callbacks.remove(self._on_gc)

    def _on_gc(self, phase: str, _info: dict[str, int]) -> None:
        if phase == "start":
            self._start_ns = self._clock.now_ns()
        else:
            self.total_ns += self._clock.now_ns() - self._start_ns


class Witness:
    """A ``TickSink`` that counts the slots missed between ticks in which the policy flew, by cause.

    Reading the counters costs the action thread some 30 us a tick, after its sticks have left.
    """

    def __init__(self, *, period_ns: int, read: Callable[[], Counters]) -> None:
        self._period_ns = period_ns
        self._read = read
        self._last: tuple[Tick, Counters] | None = None
        self._slots: dict[Cause, int] = dict.fromkeys(CAUSES, 0)

    def emit(self, event: Event) -> None:
        """Look at one tick."""
        if not isinstance(event, Tick):
            return
        if event.trace is None:
            self._last = None
            return
        counters = self._read()
        if self._last is not None and event.missed_slots:
            self._slots[self._blame(event, counters, *self._last)] += event.missed_slots
        self._last = (event, counters)

    def _blame(self, tick: Tick, after: Counters, last: Tick, before: Counters) -> Cause:
        return attribute(
            Lateness(
                overrun_ns=tick.woke_ns - last.woke_ns - self._period_ns,
                work_ns=last.sent_ns - last.woke_ns,
                predict_ns=last.predict_ns or 0,
                period_ns=self._period_ns,
                before=before,
                after=after,
            )
        )

    @property
    def missed_by_cause(self) -> dict[str, int]:
        """Slots by cause; causes that took none are left out."""
        return {str(cause): slots for cause, slots in self._slots.items() if slots}
