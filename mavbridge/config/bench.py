"""Settings of ``mavbridge bench``."""

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """One benchmark run."""

    quick: bool = False
    """A minute or two instead of nearly ten: figures to look at, not to quote."""
    json: Path | None = None
    """Write all figures here as JSON."""
    plot: Path | None = None
    """Draw the figures here as PNG; needs matplotlib (the extra "bench")."""
    check: Path | None = None
    """Compare with this budget of ratios, and exit with 1 if something got worse."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RolloutBenchConfig:
    """One benchmark of rollouts."""

    quick: bool = False
    """Short runs: figures to look at, not to quote."""
    json: Path | None = None
    """Write all figures here as JSON."""
    plot: Path | None = None
    """Draw the figures here as PNG; needs matplotlib (the extra "bench")."""
    world_model: Path | None = None
    """Weights of the world model; by default those that come with mavbridge, or else random
    ones, which take as long."""
