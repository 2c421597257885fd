import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.core.clock import NS_PER_S
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
    if len(set(values)) == 1:
        assert histogram.quantile_ns(fraction) == values[0], "exactly"


def test_extremes_are_kept_and_no_value_has_none() -> None:
    histogram = Histogram()
    assert (histogram.quantile_ns(0.5), histogram.percentiles_ms()) == (None, None)
    for value_ns in (-5, 2**50):
        histogram.add(value_ns)
    assert (histogram.min_ns, histogram.max_ns, histogram.quantile_ns(0.5)) == (-5, 2**50, 0)
    assert histogram.quantile_ns(1.0) == 2**50
