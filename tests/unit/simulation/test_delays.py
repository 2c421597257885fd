from itertools import islice

import numpy as np
import pytest

from mavbridge.core.errors import UserError
from mavbridge.simulation.delays import Fixed, LogNormal, Measured, draws_ns


def draws(delay: Fixed | LogNormal | Measured, seed: int = 0, count: int = 20_000) -> list[int]:
    return list(islice(draws_ns(delay, np.random.default_rng(seed)), count))


def test_a_log_normal_delay_has_the_percentiles_that_it_names() -> None:
    values = draws(LogNormal(p50_ns=11_000_000, p99_ns=25_000_000))
    assert np.percentile(values, 50) == pytest.approx(11e6, rel=0.02)
    assert np.percentile(values, 99) == pytest.approx(25e6, rel=0.05)
    assert min(values) > 0


def test_the_seed_alone_decides() -> None:
    delay = LogNormal(p50_ns=1000, p99_ns=3000)
    assert draws(delay, 1) == draws(delay, 1)
    assert draws(delay, 1) != draws(delay, 2)


def test_measured_delays_are_drawn_from_what_was_measured() -> None:
    values = draws(Measured((5, 7, 11)))
    assert set(values) == {5, 7, 11}
    assert values.count(7) == pytest.approx(len(values) / 3, rel=0.05)


def test_a_fixed_delay() -> None:
    assert set(draws(Fixed(42))) == {42}


@pytest.mark.parametrize(
    "make",
    [
        lambda: Fixed(-1),
        lambda: LogNormal(p50_ns=0, p99_ns=1),
        lambda: LogNormal(p50_ns=2, p99_ns=1),
        lambda: Measured(()),
        lambda: Measured((1, -1)),
    ],
)
def test_no_delay_goes_back_in_time(make: object) -> None:
    assert callable(make)
    with pytest.raises(UserError):
        make()
