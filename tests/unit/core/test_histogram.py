import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.histogram import Histogram


@given(
    st.lists(st.integers(min_value=0, max_value=10 * 60 * NS_PER_S), min_size=1, max_size=200),
    st.floats(min_value=0.001, max_value=1.0),
)
def test_quantiles_are_nearest_rank_within_the_resolution(
    values: list[int], fraction: float
) -> None:
    histogram = Histogram()
    for value in values:
        histogram.add(value)
    exact = sorted(values)[max(math.ceil(fraction * len(values)) - 1, 0)]
    assert histogram.quantile_ns(fraction) == pytest.approx(exact, rel=0.004, abs=0)
    assert histogram.count == len(values)
    assert (histogram.min_ns, histogram.max_ns) == (min(values), max(values))


@pytest.mark.parametrize("value_ns", [0, 1, 255, 256, 511, 512, NS_PER_MS, NS_PER_S])
def test_one_value_is_every_percentile_exactly(value_ns: int) -> None:
    histogram = Histogram()
    histogram.add(value_ns)
    assert histogram.quantile_ns(0.5) == value_ns
    assert histogram.quantile_ns(1.0) == value_ns


def test_one_outlier_in_a_thousand_shows_in_p999_and_max_only() -> None:
    histogram = Histogram()
    for _ in range(998):
        histogram.add(10 * NS_PER_MS)
    histogram.add(50 * NS_PER_MS)
    histogram.add(50 * NS_PER_MS)
    measured = histogram.percentiles_ms()
    assert measured is not None
    assert measured.p50 == pytest.approx(10, rel=0.004)
    assert measured.p99 == pytest.approx(10, rel=0.004)
    assert measured.p999 == pytest.approx(50, rel=0.004)
    assert measured.max == 50


def test_values_beyond_the_bins_keep_their_extremes() -> None:
    histogram = Histogram()
    histogram.add(-5)
    histogram.add(2**50)
    assert (histogram.min_ns, histogram.max_ns) == (-5, 2**50)
    assert histogram.quantile_ns(0.5) == 0


def test_an_empty_histogram_has_no_percentiles() -> None:
    assert Histogram().quantile_ns(0.5) is None
    assert Histogram().percentiles_ms() is None
