"""Settings of ``mavbridge export``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

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
    include_failed: Annotated[bool, Parameter(negative="")] = False
    """Export flights, too, that crashed, ended by a fault, were marked as bad, or missed gates."""
    image_size: int | None = None
    """Height and width of the images, as the policy is to see them; by default as recorded."""
    state: Literal["world", "body"] = "world"
    """Velocity and attitude in world axes, which mavbridge train takes; or velocity and the
    vertical in body axes, the same on every heading, which other networks learn from sooner."""

    def __post_init__(self) -> None:
        """Refuse an empty task, and a size that a video cannot have."""
        size = self.image_size
        if size is not None and (size % 2 or not 16 <= size <= 4096):
            raise UserError(f"--image-size {size}: an even number from 16 to 4096")
        if not self.task.strip():
            raise UserError("--task is empty: describe what the flights do")
