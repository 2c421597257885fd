"""Settings of ``mavbridge contract``."""

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ContractConfig:
    """Settings of ``mavbridge contract``."""

    out: Path | None = None
    """The file to write, new; by default mavbridge.toml in the folder, where flights find it."""
    dataset: Path | None = None
    """The LeRobot dataset that the policy was trained on; by default the one that LeRobot's
    training noted beside the policy, if it is here."""
