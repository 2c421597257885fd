"""Timing of a flight from the policy's first action on: a ``TickSink`` beside the flight's own."""

import os
import time
from pathlib import Path

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.records import Event, LinkStats, Tick
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport

_PROC_STAT = Path("/proc/stat")
_STEAL_FIELD = 8
"""Of the line "cpu": user nice system idle iowait irq softirq steal (proc_stat(5))."""


def stolen_ns() -> int | None:
    """Processor time that the host has taken from this machine since boot; None = not known."""
    try:
        fields = _PROC_STAT.read_text().split("\n", 1)[0].split()
    except OSError:
        return None
    if len(fields) <= _STEAL_FIELD:
        return None
    return int(fields[_STEAL_FIELD]) * NS_PER_S // os.sysconf("SC_CLK_TCK")


def since_ms(start_ns: int | None, end_ns: int | None) -> float | None:
    """Milliseconds between two readings of ``stolen_ns``."""
    if start_ns is None or end_ns is None:
        return None
    return round((end_ns - start_ns) / NS_PER_MS, 1)


class FlightMeter:
    """Counts what the flight's report counts, without the time before the policy flies.

    Waiting, handshake and arming are cheap ticks on time: they would flatter a slow engine.
    """

    def __init__(self, *, action_hz: float, vision_hz: float) -> None:
        self._timing = FlightTiming(action_hz=action_hz, vision_hz=vision_hz)
        self._is_flying = False
        self._cpu_start_ns = self._cpu_end_ns = 0
        self._stolen_start_ns: int | None = None
        self._stolen_end_ns: int | None = None

    def emit(self, event: Event) -> None:
        """Count the event."""
        if isinstance(event, Tick):
            if not self._is_flying:
                self._start(event)
                return  # the slots missed before this tick are not the flight's
            if event.trace is not None:
                self._cpu_end_ns = time.process_time_ns()
        if self._is_flying:
            self._timing.emit(event)

    def _start(self, tick: Tick) -> None:
        self._is_flying = tick.trace is not None
        self._cpu_start_ns = self._cpu_end_ns = time.process_time_ns()
        if self._is_flying:
            self._stolen_start_ns = stolen_ns()

    def end(self) -> None:
        """The flight is over: read what is not counted by tick."""
        self._stolen_end_ns = stolen_ns()

    @property
    def cpu_ns(self) -> int:
        """Processor time of this process while the policy flew."""
        return self._cpu_end_ns - self._cpu_start_ns

    @property
    def stolen_ms(self) -> float | None:
        """Processor time taken by the host meanwhile."""
        return since_ms(self._stolen_start_ns, self._stolen_end_ns)

    def report(self, *, engine: str, policy: str, link: LinkStats | None) -> TimingReport:
        """Figures of the flight so far."""
        return self._timing.report(
            mode="dual",
            engine=engine,
            policy=policy,
            autopilot=None,
            link=link,
            observer_drops=ObserverDrops(rerun=None, recorder=None),
        )
