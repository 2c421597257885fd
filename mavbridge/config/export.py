"""Settings of ``mavbridge export``."""

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from mavbridge.core.errors import UserError


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """Settings of ``mavbridge export``."""

    out: Path
    """Folder for the dataset, new or empty."""
    task: str = "fly"
    """Task of the flights, in words, for policies that are given one."""

    def __post_init__(self) -> None:
        """Refuse an empty task."""
        if not self.task.strip():
            raise UserError("--task is empty: describe what the flights do")
