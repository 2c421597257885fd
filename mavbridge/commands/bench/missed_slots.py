"""Why slots of the action loop were missed: counters of the system, read at every tick."""

import gc
import os
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.records import Event, Tick

Cause = Literal["host", "kernel", "gc", "inference", "loop", "lock"]
CAUSES: tuple[Cause, ...] = get_args(Cause)
"""host: the hypervisor gave our processor to others; kernel: the thread could run and was not put
on a processor; gc: Python's collector; inference: the policy took longer than the period; loop: the
rest of the tick did; lock: the thread was neither running nor runnable, so it waited for the
interpreter lock (or for something inside the policy) until after its slot."""
PROC_STAT = Path("/proc/stat")
STEAL_FIELD = 8
"""The line "cpu" is: cpu user nice system idle iowait irq softirq steal (proc_stat(5))."""
SCHEDSTAT = Path("/proc/thread-self/schedstat")
"""For the reading thread: ns on a processor, ns in a run queue, turns (sched-stats.rst)."""


class Counters(NamedTuple):
    """Time lost outside the loop's own work; each only ever grows, and stays 0 where unknown."""

    host_ns: int
    kernel_ns: int
    gc_ns: int


def stolen_ns() -> int | None:
    """Processor time that the hypervisor has taken since boot; None = not known."""
    try:
        fields = PROC_STAT.read_text().split("\n", 1)[0].split()
    except OSError:
        return None
    if len(fields) <= STEAL_FIELD:
        return None
    return int(fields[STEAL_FIELD]) * NS_PER_S // os.sysconf("SC_CLK_TCK")


def stolen_ms_since(start_ns: int | None) -> float | None:
    """Milliseconds since an earlier ``stolen_ns``; None = not known."""
    now_ns = stolen_ns()
    if start_ns is None or now_ns is None:
        return None
    return round((now_ns - start_ns) / NS_PER_MS, 1)


def find_cause(first: Tick, second: Tick, lost: Counters, period_ns: int) -> Cause:
    """The first cause, outermost first, that explains at least half of the overrun.

    Time that the hypervisor or the kernel took is inside everything else that was slow meanwhile,
    so they come first. What no counter explains was work if the first tick outlasted its period,
    and waiting if it did not. ``lost`` is how much the counters grew between the ends of two
    consecutive ticks.
    """
    overrun_ns = second.woke_ns - first.woke_ns - period_ns
    for cause, lost_ns in zip(CAUSES, lost, strict=False):
        if 2 * lost_ns >= overrun_ns:
            return cause
    work_ns = first.sent_ns - first.woke_ns
    if work_ns < period_ns:
        return "lock"
    return "inference" if 2 * (first.predict_ns or 0) >= work_ns else "loop"


class GcTimer:
    """Adds up the time inside the garbage collector within the ``with`` block."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._start_ns = 0
        self.total_ns = 0

    def __enter__(self) -> "GcTimer":
        gc.callbacks.append(self._on_gc)
        return self

    def __exit__(self, *_: object) -> None:
        gc.callbacks.remove(self._on_gc)

    def _on_gc(self, phase: str, _info: dict[str, int]) -> None:
        if phase == "start":
            self._start_ns = self._clock.now_ns()
        else:
            self.total_ns += self._clock.now_ns() - self._start_ns


class MissedSlotProbe:
    """A ``TickSink`` that counts the slots missed between ticks in which the policy flew, by cause.

    Reading the counters costs the action thread some 30 us a tick, after its sticks have left.
    """

    def __init__(self, *, period_ns: int, gc_timer: GcTimer) -> None:
        self._period_ns = period_ns
        self._gc_timer = gc_timer
        self._last: tuple[Tick, Counters] | None = None
        self.missed_by_cause: dict[str, int] = {}

    def emit(self, event: Event) -> None:
        """Look at one tick; called by the action thread."""
        if not isinstance(event, Tick):
            return
        if event.trace is None:
            self._last = None
            return
        now = Counters(stolen_ns() or 0, _runnable_ns(), self._gc_timer.total_ns)
        if self._last is not None and event.missed_slots:
            tick, before = self._last
            lost = Counters(*(after - old for after, old in zip(now, before, strict=True)))
            cause = find_cause(tick, event, lost, self._period_ns)
            slots = self.missed_by_cause.get(cause, 0)
            self.missed_by_cause[cause] = slots + event.missed_slots
        self._last = (event, now)


def _runnable_ns() -> int:
    try:
        return int(SCHEDSTAT.read_text().split()[1])
    except (OSError, LookupError, ValueError):
        return 0
