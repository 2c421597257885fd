"""Means and rates of a sample of flights, with 95 % confidence intervals."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

Z95 = 1.959963984540054
"""95 % of a normal distribution lie within this many standard deviations."""
_BLOCKS, _BLOCK = 100, 100
"""10,000 resamples, a block at a time."""
_SEED = 0
"""Seed of the resampling: the same flights have the same interval."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Estimate:
    """A mean or a rate; the interval is None where a single flight has none."""

    value: float
    low: float | None
    high: float | None
    count: int


def rate(successes: int, count: int) -> Estimate:
    """Share of successes with Wilson's score interval (E. B. Wilson 1927, JASA 22, 209-212).

    Raises:
        ValueError: no trials, or more successes than trials.
    """
    if not 0 <= successes <= count or count == 0:
        raise ValueError(f"{successes} successes of {count} are no rate")
    share, z2 = successes / count, Z95**2
    centre = (share + z2 / (2 * count)) / (1 + z2 / count)
    spread = math.sqrt(share * (1 - share) / count + z2 / (4 * count**2))
    half = Z95 * spread / (1 + z2 / count)
    return Estimate(
        value=share, low=max(0.0, centre - half), high=min(1.0, centre + half), count=count
    )


def mean(values: Sequence[float]) -> Estimate | None:
    """Mean with a percentile bootstrap interval (B. Efron 1979); None without values."""
    if not values:
        return None
    sample = np.asarray(values, dtype=np.float64)
    low = high = None
    if len(sample) > 1:
        random = np.random.Generator(np.random.PCG64(_SEED))
        size = (_BLOCK, len(sample))
        means = [
            sample[random.integers(len(sample), size=size)].mean(axis=1) for _ in range(_BLOCKS)
        ]
        low, high = (float(bound) for bound in np.percentile(means, (2.5, 97.5)))
    return Estimate(value=float(sample.mean()), low=low, high=high, count=len(sample))
