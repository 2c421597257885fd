import numpy as np
import pytest

from helpers.fakes import START_NS, FakeClock, FakeLink
from mavbridge.core.clock import NS_PER_MS
from mavbridge.flight.state_pacer import StatePacer

MS = NS_PER_MS
PERIOD_NS = 10 * MS


def wakes_ms(arrivals_ms: list[float], work_ms: list[float]) -> list[tuple[float, int]]:
    """(woke since start, missed) of one tick per entry of work."""
    clock = FakeClock()
    link = FakeLink(clock)
    link.attitudes_ns = [START_NS + round(t * MS) for t in arrivals_ms]
    pacer = StatePacer(clock, link, period_ns=PERIOD_NS)
    out = []
    for work in work_ms:
        slot = pacer.wait()
        out.append(((slot.woke_ns - START_NS) / MS, slot.missed))
        clock.advance_ns(round(work * MS))
    return out


def test_ticks_follow_the_arrivals() -> None:
    arrivals = [9.0, 20.5, 29.0, 41.0]
    assert wakes_ms(arrivals, [2.0] * 5) == [(0, 0), *((t, 0) for t in arrivals)]


def test_a_message_that_does_not_come_is_replaced_by_the_clock() -> None:
    assert wakes_ms([10.0, 32.5], [2.0] * 4) == [(0, 0), (10, 0), (22.5, 0), (32.5, 0)]


def test_a_faster_stream_is_thinned() -> None:
    woke = [t for t, _ in wakes_ms([k * 5.0 for k in range(200)], [1.0] * 50)]
    assert np.diff(woke).tolist() == pytest.approx([10.0] * 49)


def test_a_stall_is_counted_and_not_made_up_for() -> None:
    ticks = wakes_ms([k * 10.0 for k in range(1, 20)], [2, 47, 2, 2, 2])
    assert ticks == [(0, 0), (10, 0), (57, 4), (69.5, 0), (80, 0)]  # 60 comes too soon


def test_without_any_messages_it_is_the_clock() -> None:
    assert [t for t, _ in wakes_ms([], [2.0] * 4)] == [0, 10, 20, 30]


def test_it_finds_the_phase_of_a_stream_again_after_a_gap() -> None:
    arrivals = [10.0, 20.0, *(62.0 + 10 * k for k in range(20))]
    woke = [t for t, _ in wakes_ms(arrivals, [1.0] * 20)]
    assert woke[-1] in arrivals
    assert max(np.diff(woke)) <= 12.5
