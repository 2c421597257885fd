"""Settings of the processes that fly episodes; shared by evaluate and demonstrate."""

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from mavbridge.config.checks import check_range


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class WorkersConfig:
    """Number of episodes flown at a time, and the machines that fly them."""

    workers: int = 1
    """Episodes at a time, each in a process of its own."""
    ray: Annotated[
        bool | str, Parameter(negative="", show_default=False, metavar="[HOST:PORT]")
    ] = False
    """Fly on the Ray cluster that this machine belongs to, or on the one at HOST:PORT. Its machines
    must share the folders of files that are read and written. Needs the extra "cluster"."""

    def __post_init__(self) -> None:
        """Refuse numbers of processes that no machine runs."""
        check_range("workers", self.workers, 1, 10_000, "")

    @property
    def ray_address(self) -> str | None:
        """Address as Ray takes it; None = no cluster."""
        return "auto" if self.ray is True else self.ray or None

    @property
    def is_parallel(self) -> bool:
        """Episodes are flown in other processes than this one."""
        return self.workers > 1 or self.ray_address is not None
