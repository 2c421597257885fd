import gc

from helpers.factories import make_released_tick, make_tick, make_vision_tick
from helpers.fakes import FakeClock
from mavbridge.commands.bench.witness import GcWatch, Witness, read_counters
from mavbridge.core.clock import NS_PER_MS
from mavbridge.observe.attribution import Counters

PERIOD_NS = 10 * NS_PER_MS
QUIET = Counters(stolen_ns=0, runnable_ns=0, gc_ns=0)


def test_missed_slots_are_counted_by_cause() -> None:
    readings = iter([0, 0, 40, 40])
    witness = Witness(
        period_ns=PERIOD_NS,
        read=lambda: Counters(stolen_ns=next(readings) * NS_PER_MS, runnable_ns=0, gc_ns=0),
    )
    witness.emit(make_tick(0))
    witness.emit(make_tick(1))
    witness.emit(make_tick(6, missed_slots=4))
    witness.emit(make_tick(9, missed_slots=2))
    assert witness.missed_by_cause == {"host": 4, "lock": 2}


def test_nothing_missed_nobody_to_blame() -> None:
    witness = Witness(period_ns=PERIOD_NS, read=lambda: QUIET)
    for index in range(5):
        witness.emit(make_tick(index))
        witness.emit(make_vision_tick(index))
    assert witness.missed_by_cause == {}


def test_slots_missed_around_a_release_are_not_the_flights() -> None:
    witness = Witness(period_ns=PERIOD_NS, read=lambda: QUIET)
    witness.emit(make_tick(0))
    witness.emit(make_released_tick(5, missed_slots=4))
    witness.emit(make_tick(9, missed_slots=3))
    assert witness.missed_by_cause == {}


def test_time_in_the_collector_is_added_up() -> None:
    clock = FakeClock()

    def slow(phase: str, _info: dict[str, int]) -> None:
        if phase == "start":
            clock.sleep_until_ns(clock.now_ns() + 3 * NS_PER_MS)

    with GcWatch(clock) as watch:
        gc.callbacks.append(slow)
        try:
            gc.collect()
        finally:
            gc.callbacks.remove(slow)
        total_ns = watch.total_ns
        assert total_ns >= 3 * NS_PER_MS
    gc.collect()
    assert watch.total_ns == total_ns


def test_counters_are_read_from_this_machine() -> None:
    first, second = read_counters(1), read_counters(2)
    assert second.gc_ns == 2
    assert (first.runnable_ns or 0) <= (second.runnable_ns or 0)
    assert (first.stolen_ns or 0) <= (second.stolen_ns or 0)
