from mavbridge.core.clock import NS_PER_MS
from mavbridge.guard.guard import StickGrid

MS = NS_PER_MS
PERIOD = 10 * MS


def test_slots_come_due_on_the_grid_and_once_each() -> None:
    grid = StickGrid(PERIOD, 0)
    assert grid.next_ns == 0
    taken = []
    for now_ns in range(0, 100 * MS, MS):
        if (slot := grid.take(now_ns)) is not None:
            taken.append((slot.index, slot.due_ns, slot.missed))
            grid.serve(now_ns)
    assert taken == [(k, k * PERIOD, 0) for k in range(10)]
    assert grid.next_ns == 10 * PERIOD


def test_a_late_slot_is_served_and_moves_nothing() -> None:
    grid = StickGrid(PERIOD, 0)
    grid.take(0)
    grid.serve(0)
    slot = grid.take(19 * MS)
    assert slot is not None
    assert (slot.index, slot.due_ns, slot.missed) == (1, 10 * MS, 0)
    assert grid.next_ns == 20 * MS


def test_slots_that_nobody_served_within_a_period_are_missed() -> None:
    grid = StickGrid(PERIOD, 0)
    grid.take(0)
    grid.serve(0)
    slot = grid.take(53 * MS)
    assert slot is not None
    assert (slot.index, slot.missed) == (5, 4)
    assert grid.next_ns == 60 * MS


def test_a_slot_that_was_served_early_is_left_out() -> None:
    grid = StickGrid(PERIOD, 0)
    grid.take(0)
    grid.serve(0)
    grid.serve(6 * MS)  # a new chunk
    assert grid.take(10 * MS) is None
    grid.serve(12 * MS)  # more than half a period before the next slot
    assert grid.take(20 * MS) is not None


def test_a_stall_after_an_early_send_counts_one_slot_less() -> None:
    grid = StickGrid(PERIOD, 0)
    grid.take(0)
    grid.serve(7 * MS)
    slot = grid.take(35 * MS)
    assert slot is not None
    assert (slot.index, slot.missed) == (3, 1)


def test_a_send_just_half_a_period_early_leaves_the_slot_to_be_served() -> None:
    grid = StickGrid(PERIOD, 0)
    grid.take(0)
    grid.serve(5 * MS)
    assert grid.take(10 * MS) is not None
    grid.serve(15 * MS + 1)
    assert grid.take(20 * MS) is None
