"""Why slots of the guard were missed, and its processor time: counters of the system."""

import os
from collections import deque
from pathlib import Path
from typing import Literal, NamedTuple

from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.records import Event, Tick

Cause = Literal["host", "kernel", "guard"]
"""host: the hypervisor gave our processor to others; kernel: the guard could run and was not put on
a processor; guard: neither, so its own work or its link took that long."""
PROC = Path("/proc")
MAX_READINGS = 512
"""More than a second at 400 Hz."""
STEAL_FIELD = 8
"""The line "cpu" is: cpu user nice system idle iowait irq softirq steal (proc_stat(5))."""


class Counters(NamedTuple):
    """Times of the guard and of its machine; each only ever grows, and stays 0 where unknown."""

    host_ns: int
    """Taken by the hypervisor since boot, from all processors."""
    waited_ns: int
    """The guard could run and was not running."""
    cpu_ns: int
    """The guard ran."""


def read_counters(pid: int) -> Counters:
    """Counters of a process with one thread; schedstat is documented in sched-stats.rst."""
    try:
        cpu_ns, waited_ns = map(int, (PROC / str(pid) / "schedstat").read_text().split()[:2])
        stolen = int((PROC / "stat").read_text().split("\n", 1)[0].split()[STEAL_FIELD])
    except (OSError, ValueError, IndexError):
        return Counters(0, 0, 0)
    host_ns = stolen * NS_PER_S // os.sysconf("SC_CLK_TCK")
    return Counters(host_ns=host_ns, waited_ns=waited_ns, cpu_ns=cpu_ns)


def find_cause(first: Tick, second: Tick, before: Counters, after: Counters) -> Cause:
    """The first cause, outermost first, that explains at least half of the gap between two sends.

    Time that the hypervisor took is inside all other times, so it comes first.
    """
    gap_ns = second.sent_ns - first.sent_ns
    if 2 * (after.host_ns - before.host_ns) >= gap_ns:
        return "host"
    return "kernel" if 2 * (after.waited_ns - before.waited_ns) >= gap_ns else "guard"


class GuardProbe:
    """A ``TickSink`` that reads the guard's counters from the policy's first action to its last.

    It runs in the flight process, so reading costs the guard nothing, but may come late: a gap is
    explained by what the counters grew since they were last read before it began.
    """

    def __init__(self, pid: int, clock: Clock) -> None:
        self._pid = pid
        self._clock = clock
        self._last: Tick | None = None
        self._read: deque[tuple[int, Counters]] = deque(maxlen=MAX_READINGS)
        self._first: Counters | None = None
        self._newest: Counters | None = None
        self.missed_by_cause: dict[str, int] = {}
        """Slots missed while the policy flew."""

    @property
    def cpu_ns(self) -> int:
        """Processor time of the guard; 0 where the system does not tell."""
        if self._first is None or self._newest is None:
            return 0
        return self._newest.cpu_ns - self._first.cpu_ns

    def emit(self, event: Event) -> None:
        """Look at one tick."""
        if not isinstance(event, Tick):
            return
        if event.trace is None:
            self._last = None
            return
        now = read_counters(self._pid)
        self._first, self._newest = self._first or now, now
        if self._last is not None and event.missed_slots:
            cause = find_cause(self._last, event, self._before(self._last.sent_ns), now)
            slots = self.missed_by_cause.get(cause, 0)
            self.missed_by_cause[cause] = slots + event.missed_slots
        self._last = event
        self._read.append((self._clock.now_ns(), now))

    def _before(self, at_ns: int) -> Counters:
        """The newest counters that were read by a time, or the oldest that are kept."""
        early = (counters for read_ns, counters in reversed(self._read) if read_ns <= at_ns)
        return next(early, self._read[0][1])
