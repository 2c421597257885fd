"""Simulated time: the clock, durations of work, and channels that take them."""

from itertools import cycle, islice

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.simulation.clock import SteppedClock
from mavbridge.simulation.delays import Delay
from mavbridge.simulation.network import DelayedChannel


def test_an_event_must_not_wait_but_may_ask_for_a_time_that_has_passed() -> None:
    clock, seen = SteppedClock(0), []
    clock.schedule(0, lambda: clock.sleep_until_ns(0))
    clock.schedule(0, lambda: seen.append(clock.now_ns()))
    clock.sleep_until_ns(0)
    assert seen == [0]
    clock.schedule(1, lambda: clock.sleep_until_ns(2))
    with pytest.raises(RuntimeError, match="must not wait"):
        clock.sleep_until_ns(1)


def samples(delay: Delay, seed: int = 0, count: int = 20_000) -> list[int]:
    return list(islice(delay.samples_ns(np.random.default_rng(seed)), count))


def test_a_log_normal_delay_has_its_percentiles() -> None:
    values = samples(Delay(p50_ns=11_000_000, p99_ns=25_000_000))
    assert np.percentile(values, 50) == pytest.approx(11e6, rel=0.02)
    assert np.percentile(values, 99) == pytest.approx(25e6, rel=0.05)
    assert min(values) > 0


def test_the_seed_decides_and_the_offset_is_added_to_every_sample() -> None:
    delay, later = (Delay(p50_ns=1000, p99_ns=3000, offset_ns=offset) for offset in (0, 70))
    assert samples(delay, 1) == samples(delay, 1)
    assert samples(delay, 1) != samples(delay, 2)
    assert samples(later, 1) == [value + 70 for value in samples(delay, 1)]


def test_a_fixed_delay() -> None:
    assert set(samples(Delay(p50_ns=42))) == {42}
    assert set(samples(Delay(p50_ns=0, offset_ns=5))) == {5}


@given(st.lists(st.integers(0, 50), min_size=1, max_size=20))
def test_no_datagram_overtakes_another(delays_ns: list[int]) -> None:
    clock = SteppedClock(0)
    up = DelayedChannel(clock, cycle(delays_ns))
    for number in range(len(delays_ns)):
        up.send(bytes([number]))
        clock.sleep_until_ns(clock.now_ns() + 1)
    clock.sleep_until_ns(10_000)
    arrived = list(up.receive())
    assert [data[0] for _, data in arrived] == list(range(len(delays_ns)))
    assert [stamp for stamp, _ in arrived] == sorted(stamp for stamp, _ in arrived)
    assert all(
        stamp >= sent_ns + delay_ns
        for sent_ns, (delay_ns, (stamp, _)) in enumerate(zip(delays_ns, arrived, strict=True))
    )
