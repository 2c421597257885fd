"""Histogram of durations in constant memory."""

from collections import Counter

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.vehicle import Percentiles

_BITS = 8
"""Leading bits of a duration that tell its bin: a bin is at most 1/128 = 0.8 % wide."""


class Histogram:
    """Distribution of durations in constant memory: percentiles within 0.4 %, exact extremes.

    Bins double in width from one octave to the next (G. Tene, HdrHistogram). One thread adds;
    another may read at any time.
    """

    def __init__(self) -> None:
        self._counts: Counter[tuple[int, int]] = Counter()
        """By width of the bin, as a power of two, and leading bits."""
        self.count = 0
        self.min_ns: int | None = None
        self.max_ns: int | None = None

    def add(self, value_ns: int) -> None:
        """Add a duration; negative ones count in the first bin."""
        shift = max(value_ns.bit_length() - _BITS, 0)
        self._counts[(shift, value_ns >> shift) if value_ns > 0 else (0, 0)] += 1
        self.min_ns = value_ns if self.min_ns is None else min(self.min_ns, value_ns)
        self.max_ns = value_ns if self.max_ns is None else max(self.max_ns, value_ns)
        self.count += 1

    def quantile_ns(self, fraction: float) -> float | None:
        """Return the nearest-rank quantile, ``fraction`` in (0, 1]; None if empty.

        The value is the middle of its bin, limited to the exact extremes.
        """
        counts = sorted(dict(self._counts).items())
        rank, seen = fraction * sum(count for _, count in counts), 0
        for (shift, leading), count in counts:
            seen += count
            if seen >= rank:
                middle_ns = (leading << shift) + ((1 << shift) - 1) / 2
                return min(max(middle_ns, self.min_ns or 0), self.max_ns or 0)
        return None

    def percentiles_ms(self) -> Percentiles | None:
        """Return p50, p99, p99.9 and the exact maximum [ms]; None if empty."""
        quantiles_ns = (*map(self.quantile_ns, (0.5, 0.99, 0.999)), self.max_ns)
        p50, p99, p999, longest = (round((ns or 0) / NS_PER_MS, 3) for ns in quantiles_ns)
        return Percentiles(p50=p50, p99=p99, p999=p999, max=longest) if self.count else None
