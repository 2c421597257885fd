import pytest

from mavbridge.simulation.clock import START_NS, SteppedClock


def test_events_run_at_their_time_in_order_of_scheduling() -> None:
    clock = SteppedClock(0)
    seen: list[tuple[str, int]] = []
    clock.schedule(20, lambda: seen.append(("late", clock.now_ns())))
    clock.schedule(10, lambda: seen.append(("first", clock.now_ns())))
    clock.schedule(10, lambda: seen.append(("second", clock.now_ns())))
    clock.sleep_until_ns(15)
    assert seen == [("first", 10), ("second", 10)]
    assert clock.now_ns() == 15
    clock.sleep_until_ns(20)
    assert seen[-1] == ("late", 20)


def test_time_never_goes_back() -> None:
    clock = SteppedClock()
    clock.sleep_until_ns(START_NS + 5)
    clock.sleep_until_ns(START_NS)
    late: list[int] = []
    clock.schedule(START_NS, lambda: late.append(clock.now_ns()))
    clock.sleep_until_ns(START_NS + 5)
    assert late == [START_NS + 5]


def test_an_event_must_not_wait_but_may_ask_for_a_time_that_has_passed() -> None:
    clock, seen = SteppedClock(0), []
    clock.schedule(0, lambda: clock.sleep_until_ns(0))
    clock.schedule(0, lambda: seen.append(clock.now_ns()))
    clock.sleep_until_ns(0)
    assert seen == [0]
    clock.schedule(1, lambda: clock.sleep_until_ns(2))
    with pytest.raises(RuntimeError, match="must not wait"):
        clock.sleep_until_ns(1)
