"""How long things take in an episode, since simulated work takes no time by itself."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError

_Z99 = 2.3263478740408408
"""99 % of a normal distribution lie below this many standard deviations."""
_BLOCK = 1024
"""Draws made at once: numpy's cost of a single one is that of a hundred."""


class Delay(Protocol):
    """A distribution of durations."""

    def sample_ns(self, random: np.random.Generator, count: int) -> list[int]:
        """``count`` durations in ns, none below zero."""
        ...


@dataclass(frozen=True, slots=True)
class Fixed:
    """Always the same."""

    ns: int

    def __post_init__(self) -> None:
        """Refuse to go back in time."""
        if self.ns < 0:
            raise UserError(f"a delay cannot be negative, got {self.ns} ns")

    def sample_ns(self, random: np.random.Generator, count: int) -> list[int]:
        """It, ``count`` times."""
        return [self.ns] * count


@dataclass(frozen=True, slots=True, kw_only=True)
class LogNormal:
    """A median and a tail: what shared processors make of a fixed amount of work."""

    p50_ns: int
    p99_ns: int

    def __post_init__(self) -> None:
        """Refuse what is no distribution."""
        if not 0 < self.p50_ns <= self.p99_ns:
            raise UserError(
                f"a log-normal delay needs 0 < p50 <= p99, got {self.p50_ns} and {self.p99_ns} ns"
            )

    def sample_ns(self, random: np.random.Generator, count: int) -> list[int]:
        """Independent draws."""
        sigma = math.log(self.p99_ns / self.p50_ns) / _Z99
        draws: list[int] = np.rint(random.lognormal(math.log(self.p50_ns), sigma, count)).tolist()
        return [int(value) for value in draws]


@dataclass(frozen=True, slots=True)
class Measured:
    """Draws from what was measured, each value as likely as the others."""

    values_ns: tuple[int, ...]

    def __post_init__(self) -> None:
        """Refuse an empty measurement and negative times."""
        if not self.values_ns or min(self.values_ns) < 0:
            raise UserError("measured delays are one or more values in ns, none below zero")

    def sample_ns(self, random: np.random.Generator, count: int) -> list[int]:
        """Independent draws, with replacement."""
        return [self.values_ns[index] for index in random.integers(len(self.values_ns), size=count)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Longer:
    """Another distribution, and a fixed time on top."""

    than: Delay
    by_ns: int

    def __post_init__(self) -> None:
        """Refuse to go back in time."""
        if self.by_ns < 0:
            raise UserError(f"a delay cannot get shorter, got {self.by_ns} ns")

    def sample_ns(self, random: np.random.Generator, count: int) -> list[int]:
        """The other's draws, each longer."""
        return [ns + self.by_ns for ns in self.than.sample_ns(random, count)]


@dataclass(frozen=True, slots=True, kw_only=True)
class Delays:
    """Of one episode; by default what a flight with TOGE small takes on two shared cores."""

    camera: Delay = field(default=Fixed(3 * NS_PER_MS))
    """Exposure to the frame being there."""
    vision: Delay = field(default=LogNormal(p50_ns=11 * NS_PER_MS, p99_ns=25 * NS_PER_MS))
    """Image to feature."""
    action: Delay = field(default=LogNormal(p50_ns=3 * NS_PER_MS, p99_ns=6 * NS_PER_MS))
    """State to chunk; in single-rate mode the time for the image comes on top."""
    uplink: Delay = field(default=Fixed(3 * NS_PER_MS // 10))
    """Bridge to vehicle."""
    downlink: Delay = field(default=Fixed(3 * NS_PER_MS // 10))
    """Vehicle to bridge."""


NO_DELAYS = Delays(
    camera=Fixed(0), vision=Fixed(0), action=Fixed(0), uplink=Fixed(0), downlink=Fixed(0)
)


def draws_ns(delay: Delay, random: np.random.Generator) -> Iterator[int]:
    """One duration after the other, for ever; the seed alone decides which."""
    while True:
        yield from delay.sample_ns(random, _BLOCK)
