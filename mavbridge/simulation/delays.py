"""Durations of simulated work, which takes no time by itself."""

import math
from bisect import bisect
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import repeat

import numpy as np

from mavbridge.core.clock import NS_PER_MS, NS_PER_S

_Z99 = 2.3263478740408408
"""Standard deviations below which 99 % of a normal distribution lie."""
_BLOCK = 1024
"""Samples per draw: in numpy one sample costs as much as a hundred."""

STALLS_APART_S = (1.5, 4.5)
"""Time from the end of one stall to the next one, uniformly distributed."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Delay:
    """Log-normal duration, typical of work on shared processors, or a fixed one."""

    p50_ns: int
    p99_ns: int | None = None
    """None = every sample is p50_ns."""
    offset_ns: int = 0

    def samples_ns(self, random: np.random.Generator) -> Iterator[int]:
        """Yield independent samples without end."""
        if self.p99_ns is None:
            yield from repeat(self.p50_ns + self.offset_ns)
            return
        mean, sigma = math.log(self.p50_ns), math.log(self.p99_ns / self.p50_ns) / _Z99
        while True:
            for sample_ns in np.rint(random.lognormal(mean, sigma, _BLOCK)).tolist():
                yield int(sample_ns) + self.offset_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class Delays:
    """Delays of one flight; the defaults are those of TOGE small on two shared cores."""

    camera: Delay = Delay(p50_ns=3 * NS_PER_MS)
    """From the end of the exposure to the frame's arrival."""
    vision: Delay = Delay(p50_ns=11 * NS_PER_MS, p99_ns=25 * NS_PER_MS)
    """From image to feature."""
    action: Delay = Delay(p50_ns=3 * NS_PER_MS, p99_ns=6 * NS_PER_MS)
    """From state to chunk; a single-rate policy adds the time for the image."""
    hop: Delay = Delay(p50_ns=NS_PER_MS // 10, p99_ns=NS_PER_MS // 2)
    """Message between the flight process and the guard, in either direction."""
    uplink: Delay = Delay(p50_ns=NS_PER_MS * 3 // 10)
    downlink: Delay = Delay(p50_ns=NS_PER_MS * 3 // 10)
    stall_ns: int = 0
    """Duration of the flight process' stalls, at random, on average 3 s apart; 0 = none."""


class Stalls:
    """Stalls of the flight process; its messages, in and out, are held back until a stall ends."""

    def __init__(self, stall_ns: int, start_ns: int, random: np.random.Generator) -> None:
        self._stall_ns = stall_ns
        self._starts_ns = [start_ns]
        self._random = random

    def end_ns(self, at_ns: int) -> int:
        """Return the end of the stall at ``at_ns``; between stalls, ``at_ns`` itself."""
        starts_ns = self._starts_ns
        while self._stall_ns and starts_ns[-1] <= at_ns:
            apart_ns = round(self._random.uniform(*STALLS_APART_S) * NS_PER_S)
            starts_ns.append(starts_ns[-1] + self._stall_ns + apart_ns)
        return max(at_ns, starts_ns[max(bisect(starts_ns, at_ns) - 1, 0)] + self._stall_ns)
