"""Settings of ``mavbridge export``."""

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from mavbridge.core.errors import UserError


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """One LeRobot dataset made of flights."""

    out: Path
    """Folder for the dataset, new or empty."""
    task: str = "fly"
    """What the flights do, in words, for policies that are given a task."""

    def __post_init__(self) -> None:
        """Refuse an empty task."""
        if not self.task.strip():
            raise UserError("--task must say something")
