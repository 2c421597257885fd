from itertools import islice

import numpy as np
import pytest

from mavbridge.core.errors import UserError
from mavbridge.simulation.delays import Delay


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


@pytest.mark.parametrize(
    ("p50_ns", "p99_ns", "offset_ns"), [(-1, None, 0), (0, 1, 0), (2, 1, 0), (1, None, -1)]
)
def test_impossible_delays_are_refused(p50_ns: int, p99_ns: int | None, offset_ns: int) -> None:
    with pytest.raises(UserError, match="delay"):
        Delay(p50_ns=p50_ns, p99_ns=p99_ns, offset_ns=offset_ns)
