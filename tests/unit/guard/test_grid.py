import pytest

from mavbridge.core.clock import NS_PER_MS
from mavbridge.guard.values import StickGrid

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


@pytest.mark.parametrize(
    ("served_ms", "now_ms", "index", "missed"),
    [
        (0, 19, 1, 0),
        (0, 53, 5, 4),  # nobody served four of them within a period
        (7, 35, 3, 1),  # the first of them was served early
    ],
)
def test_a_late_slot_is_served_and_moves_nothing(
    served_ms: int, now_ms: int, index: int, missed: int
) -> None:
    grid = StickGrid(PERIOD, 0)
    grid.take(0)
    grid.serve(served_ms * MS)
    slot = grid.take(now_ms * MS)
    assert slot is not None
    assert (slot.index, slot.due_ns, slot.missed) == (index, index * PERIOD, missed)
    assert grid.next_ns == (index + 1) * PERIOD


def test_a_slot_that_was_served_less_than_half_a_period_early_is_left_out() -> None:
    grid = StickGrid(PERIOD, 0)
    grid.take(0)
    for slot_ms, served_ns, is_left_out in (
        (10, 6 * MS, True),  # by a new chunk
        (20, 12 * MS, False),
        (30, 25 * MS, False),
        (40, 35 * MS + 1, True),
    ):
        grid.serve(served_ns)
        assert (grid.take(slot_ms * MS) is None) is is_left_out


@pytest.mark.parametrize(
    ("sends", "missed"),
    [
        ({10: False, 20: True}, 1),
        ({5: True, 10: False, 20: True}, 1),
        ({10: False, 13: True, 20: True}, 0),  # a new chunk within the period
        ({10: True, 13: False, 20: True}, 0),
        ({10: False, 20: False, 30: True}, 2),
        ({10: False, 45: True}, 3),  # and a stall
    ],
)
def test_a_slot_whose_send_was_refused_is_missed(sends: dict[int, bool], missed: int) -> None:
    grid, counted = StickGrid(PERIOD, 0), 0
    for at_ms, is_taken in {0: True, **sends}.items():
        slot = grid.take(at_ms * MS)
        counted += slot.missed if slot else 0
        grid.serve(at_ms * MS)
        if not is_taken:
            grid.unserve()
    assert counted == missed
