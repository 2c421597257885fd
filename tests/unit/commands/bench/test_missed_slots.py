import gc
from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers.factories import make_released_tick, make_tick, make_vision_tick
from helpers.fakes import FakeClock
from mavbridge.commands.bench import missed_slots
from mavbridge.commands.bench.missed_slots import (
    CAUSES,
    Cause,
    Counters,
    GcTimer,
    MissedSlotProbe,
    find_cause,
    stolen_ms_since,
    stolen_ns,
)
from mavbridge.core.clock import NS_PER_MS

PERIOD_NS = 10 * NS_PER_MS
NOTHING_LOST = Counters(0, 0, 0)


def cause(lost: Counters, *, work_ms: int = 2, predict_ms: int | None = 1) -> Cause:
    """The cause of four missed slots after a tick: an overrun of 40 ms."""
    first = make_tick(0)
    first = make_tick(
        0,
        sent_ns=first.woke_ns + work_ms * NS_PER_MS,
        predict_ns=None if predict_ms is None else predict_ms * NS_PER_MS,
    )
    return find_cause(first, make_tick(5, missed_slots=4), lost, PERIOD_NS)


@pytest.mark.parametrize("index", range(3))
def test_a_counter_that_explains_half_of_the_overrun_is_the_cause(index: int) -> None:
    for lost_ms, expected in ((20, CAUSES[index]), (19, "lock")):
        lost = [0, 0, 0]
        lost[index] = lost_ms * NS_PER_MS
        assert cause(Counters(*lost)) == expected


def test_the_outermost_cause_comes_first() -> None:
    assert cause(Counters(*[40 * NS_PER_MS] * 3)) == "host"


@pytest.mark.parametrize(
    ("work_ms", "predict_ms", "expected"),
    [(9, 8, "lock"), (10, 5, "inference"), (50, 24, "loop"), (50, None, "loop")],
)
def test_what_no_counter_explains_was_work_or_waiting(
    work_ms: int, predict_ms: int | None, expected: Cause
) -> None:
    assert cause(NOTHING_LOST, work_ms=work_ms, predict_ms=predict_ms) == expected


@pytest.fixture
def stat(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The kernel's counter of stolen time, in ticks of 10 ms."""
    path = tmp_path / "stat"
    monkeypatch.setattr(missed_slots, "PROC_STAT", path)
    monkeypatch.setattr(missed_slots, "SCHEDSTAT", tmp_path / "none")
    monkeypatch.setattr(missed_slots.os, "sysconf", lambda _: 100)
    return path


def write_stolen(stat: Path, hundredths: int) -> None:
    stat.write_text(f"cpu  100 0 50 9000 3 0 7 {hundredths} 0 0\ncpu0 50 0 25 4500 1 0 3 1 0 0\n")


@pytest.fixture
def probe(stat: Path) -> Iterator[MissedSlotProbe]:
    write_stolen(stat, 0)
    with GcTimer(FakeClock()) as gc_timer:
        yield MissedSlotProbe(period_ns=PERIOD_NS, gc_timer=gc_timer)


def test_missed_slots_are_counted_by_cause(probe: MissedSlotProbe, stat: Path) -> None:
    probe.emit(make_tick(0))
    probe.emit(make_tick(1))
    write_stolen(stat, 4)
    probe.emit(make_tick(6, missed_slots=4))
    probe.emit(make_tick(9, missed_slots=2))
    assert probe.missed_by_cause == {"host": 4, "lock": 2}


def test_ticks_on_time_and_frames_count_nothing(probe: MissedSlotProbe) -> None:
    for index in range(5):
        probe.emit(make_tick(index))
        probe.emit(make_vision_tick(index))
    assert probe.missed_by_cause == {}


def test_slots_missed_around_a_release_do_not_count(probe: MissedSlotProbe) -> None:
    probe.emit(make_tick(0))
    probe.emit(make_released_tick(5, missed_slots=4))
    probe.emit(make_tick(9, missed_slots=3))
    assert probe.missed_by_cause == {}


def test_time_in_the_collector_is_added_up() -> None:
    clock = FakeClock()

    def slow(phase: str, _info: dict[str, int]) -> None:
        if phase == "start":
            clock.sleep_until_ns(clock.now_ns() + 3 * NS_PER_MS)

    with GcTimer(clock) as timer:
        gc.callbacks.append(slow)
        try:
            gc.collect()
        finally:
            gc.callbacks.remove(slow)
        total_ns = timer.total_ns
        assert total_ns >= 3 * NS_PER_MS
    gc.collect()
    assert timer.total_ns == total_ns


def test_stolen_time_is_what_the_kernel_counts(stat: Path) -> None:
    write_stolen(stat, 20)
    before_ns = stolen_ns()
    write_stolen(stat, 23)
    assert stolen_ms_since(before_ns) == 30.0


@pytest.mark.parametrize("text", [None, "cpu  100 0 50\n"])
def test_stolen_time_is_unknown_where_nobody_counts_it(stat: Path, text: str | None) -> None:
    if text is not None:
        stat.write_text(text)
    assert stolen_ns() is None
    assert stolen_ms_since(5) is None
