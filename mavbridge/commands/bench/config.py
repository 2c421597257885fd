"""Settings of ``mavbridge bench``."""

from dataclasses import dataclass, field
from pathlib import Path

from cyclopts import Parameter

from mavbridge.config.policy import PolicyConfig
from mavbridge.config.rates import Rates


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BenchOutputs:
    """Duration of the measurement, and destinations of its results."""

    quick: bool = False
    """Measure for seconds instead of minutes: figures to look at, not to quote."""
    json: Path | None = None
    """Write all figures here as JSON."""
    plot: Path | None = None
    """Draw the figures here as PNG; needs matplotlib (the extra "bench")."""
    check: Path | None = None
    """Compare with this budget of ratios, and exit with 1 if one is exceeded."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class BenchConfig:
    """One benchmark of one policy."""

    outputs: BenchOutputs = field(default_factory=BenchOutputs)
    policy: PolicyConfig = field(default_factory=PolicyConfig)
    rates: Rates = field(default_factory=Rates)
