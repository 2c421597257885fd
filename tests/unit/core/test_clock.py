import pytest

from helpers.fakes import FakeClock
from mavbridge.core.clock import NS_PER_MS, GridPacer

PERIOD_NS = 10 * NS_PER_MS


def run(clock: FakeClock, work_ns: list[int]) -> list[tuple[int, int, int]]:
    """(index, woke since start in ms, missed) of one slot per entry of work."""
    pacer = GridPacer(clock, period_ns=PERIOD_NS)
    start_ns = clock.now_ns()
    slots = []
    for work in work_ns:
        slot = pacer.wait()
        slots.append((slot.index, (slot.woke_ns - start_ns) // NS_PER_MS, slot.missed))
        clock.advance_ns(work)
    return slots


@pytest.mark.parametrize(
    ("work_ms", "expected"),
    [
        ([2, 2, 2], [(0, 0, 0), (1, 10, 0), (2, 20, 0)]),
        # one stall of five slots: they are skipped, the phase stays
        ([52, 2, 2], [(0, 0, 0), (5, 52, 4), (6, 60, 0)]),
        ([53, 2, 2], [(0, 0, 0), (6, 60, 5), (7, 70, 0)]),
        # late by less than a quarter of a period: fires at once, and nothing is lost
        ([12, 2, 2], [(0, 0, 0), (1, 12, 0), (2, 20, 0)]),
        ([13, 2, 2], [(0, 0, 0), (2, 20, 1), (3, 30, 0)]),
        # always too slow: every other slot
        ([15, 15, 15], [(0, 0, 0), (2, 20, 1), (4, 40, 1)]),
    ],
)
def test_slots_stay_on_the_grid_and_are_never_made_up_for(
    work_ms: list[int], expected: list[tuple[int, int, int]]
) -> None:
    assert run(FakeClock(), [work * NS_PER_MS for work in work_ms]) == expected


def test_oversleep_does_not_accumulate() -> None:
    clock = FakeClock(oversleep_ns=NS_PER_MS)
    slots = run(clock, [2 * NS_PER_MS] * 1001)
    assert slots[-1] == (1000, 10_001, 0)


def test_every_slot_is_either_met_or_counted_as_missed() -> None:
    clock = FakeClock()
    slots = run(clock, [(7919 * k % 37) * NS_PER_MS for k in range(500)])
    assert slots[-1][0] == len(slots) - 1 + sum(missed for _, _, missed in slots)


def test_a_period_must_be_positive() -> None:
    with pytest.raises(ValueError, match="positive"):
        GridPacer(FakeClock(), period_ns=0)
