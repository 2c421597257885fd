import pytest

from mavbridge.simulation.clock import SteppedClock


def test_an_event_must_not_wait_but_may_ask_for_a_time_that_has_passed() -> None:
    clock, seen = SteppedClock(0), []
    clock.schedule(0, lambda: clock.sleep_until_ns(0))
    clock.schedule(0, lambda: seen.append(clock.now_ns()))
    clock.sleep_until_ns(0)
    assert seen == [0]
    clock.schedule(1, lambda: clock.sleep_until_ns(2))
    with pytest.raises(RuntimeError, match="must not wait"):
        clock.sleep_until_ns(1)
