from pathlib import Path

import pytest

from benchmarks import missed_slots
from benchmarks.missed_slots import (
    Cause,
    Counters,
    GuardProbe,
    find_cause,
    read_counters,
)
from helpers.factories import make_tick
from helpers.fakes import FakeClock
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.records import Tick

PID = 7
NOTHING = Counters(0, 0, 0)


@pytest.mark.parametrize(
    ("host_ms", "waited_ms", "expected"),
    [(25, 0, "host"), (24, 25, "kernel"), (50, 50, "host"), (24, 24, "guard")],
)
def test_the_outermost_counter_that_explains_half_of_a_gap_is_the_cause(
    host_ms: int, waited_ms: int, expected: Cause
) -> None:
    lost = Counters(host_ms * NS_PER_MS, waited_ms * NS_PER_MS, 0)
    five_periods = (make_tick(0), make_tick(5, missed_slots=4))
    assert find_cause(*five_periods, NOTHING, lost) == expected


@pytest.fixture
def proc(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The kernel's files: a guard that has run for 1 ms, and nothing stolen."""
    monkeypatch.setattr(missed_slots, "PROC", tmp_path)
    monkeypatch.setattr(missed_slots.os, "sysconf", lambda _: 100)
    (tmp_path / str(PID)).mkdir()
    write(tmp_path, stolen_ms=0, cpu_ms=1, waited_ms=0)
    return tmp_path


def write(proc: Path, *, stolen_ms: int, cpu_ms: int, waited_ms: int) -> None:
    stat = f"cpu  100 0 50 9000 3 0 7 {stolen_ms // 10} 0 0\ncpu0 50 0 25 4500 1 0 3 1 0 0\n"
    (proc / "stat").write_text(stat)
    schedstat = f"{cpu_ms * NS_PER_MS} {waited_ms * NS_PER_MS} 12\n"
    (proc / str(PID) / "schedstat").write_text(schedstat)


class Reader:
    """A probe whose thread takes each tick ``late_ms`` after its send."""

    def __init__(self) -> None:
        self.clock = FakeClock()
        self.probe = GuardProbe(PID, self.clock)

    def take(self, tick: Tick, *, late_ms: int = 0) -> None:
        self.clock.sleep_until_ns(tick.sent_ns + late_ms * NS_PER_MS)
        self.probe.emit(tick)


def test_missed_slots_are_counted_by_cause(proc: Path) -> None:
    reader = Reader()
    reader.take(make_tick(0))
    reader.take(make_tick(1))
    write(proc, stolen_ms=40, cpu_ms=2, waited_ms=0)
    reader.take(make_tick(6, missed_slots=4))
    reader.take(make_tick(9, missed_slots=2))
    write(proc, stolen_ms=40, cpu_ms=5, waited_ms=30)
    reader.take(make_tick(12, missed_slots=2))
    probe = reader.probe
    assert probe.missed_by_cause == {"host": 4, "guard": 2, "kernel": 2}
    assert probe.cpu_ns == 4 * NS_PER_MS


def test_a_system_that_tells_nothing_leaves_the_guard_as_the_cause(proc: Path) -> None:
    (proc / "stat").unlink()
    (proc / str(PID) / "schedstat").unlink()
    assert read_counters(PID) == NOTHING
    probe = GuardProbe(PID, FakeClock())
    probe.emit(make_tick(0))
    probe.emit(make_tick(3, missed_slots=2))
    assert (probe.missed_by_cause, probe.cpu_ns) == ({"guard": 2}, 0)
