"""Histogram of durations in constant memory."""

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import Percentiles

_SUB_BITS = 7
"""128 bins per octave: a bin is at most 1/128 = 0.8 % wide."""
_SUB_BINS = 1 << _SUB_BITS
_LARGEST_NS = (1 << 42) - 1
"""73 minutes. Longer durations share the last bin."""
_BINS = (43 - _SUB_BITS) * _SUB_BINS


class Histogram:
    """Distribution of durations in constant memory: percentiles within 0.4 %, exact extremes.

    Bins are linear within an octave and double in width from one octave to the next, so that the
    index needs a shift and no logarithm (G. Tene, HdrHistogram). One thread adds; another may read
    at any time.
    """

    def __init__(self) -> None:
        self._counts = [0] * _BINS
        self.count = 0
        self.min_ns: int | None = None
        self.max_ns: int | None = None

    def add(self, value_ns: int) -> None:
        """Add a duration; negative ones count in the first bin."""
        clamped = 0 if value_ns < 0 else min(value_ns, _LARGEST_NS)
        shift = clamped.bit_length() - (_SUB_BITS + 1)
        if shift < 0:
            shift = 0
        self._counts[(shift << _SUB_BITS) + (clamped >> shift)] += 1
        if self.min_ns is None or self.max_ns is None:
            self.min_ns = self.max_ns = value_ns
        elif value_ns > self.max_ns:
            self.max_ns = value_ns
        elif value_ns < self.min_ns:
            self.min_ns = value_ns
        self.count += 1

    def quantile_ns(self, fraction: float) -> float | None:
        """Return the nearest-rank quantile, ``fraction`` in (0, 1]; None if empty.

        The value is the middle of its bin, limited to the exact extremes.
        """
        if self.min_ns is None or self.max_ns is None:
            return None
        rank = fraction * sum(self._counts)
        seen = 0
        for index, count in enumerate(self._counts):
            seen += count
            if count and seen >= rank:
                shift = max((index >> _SUB_BITS) - 1, 0)
                low_ns = (index - (shift << _SUB_BITS)) << shift
                middle_ns = low_ns + ((1 << shift) - 1) / 2
                return min(max(middle_ns, self.min_ns), self.max_ns)
        return self.max_ns

    def percentiles_ms(self) -> Percentiles | None:
        """Return p50, p99, p99.9 and the exact maximum [ms]; None if empty."""
        quantiles_ns = (*map(self.quantile_ns, (0.5, 0.99, 0.999)), self.max_ns)
        p50, p99, p999, longest = (round((ns or 0) / NS_PER_MS, 3) for ns in quantiles_ns)
        return Percentiles(p50=p50, p99=p99, p999=p999, max=longest) if self.count else None
