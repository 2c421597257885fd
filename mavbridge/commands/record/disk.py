"""How long there is still room on the disk for what is being recorded."""

from collections.abc import Callable
from pathlib import Path
from shutil import disk_usage

from mavbridge.core.clock import NS_PER_S

FIRST_BYTES_PS = 600_000.0
"""Assumed before anything was measured: 224 x 224 at 30 Hz and 100 rows a second take half."""
LEAST_S = 60.0
"""Room for so long is needed to begin an episode."""
MEASURED_NS = 5 * NS_PER_S
"""Length of the part of an episode by which its bytes a second are measured."""


def free_bytes(folder: Path) -> int:
    """What an ordinary user may still write there; raises OSError."""
    return disk_usage(folder).free


class DiskWatch:
    """Room on the disk, at the bytes a second of the newest episode."""

    def __init__(
        self, folder: Path, *, reserve_bytes: float, free: Callable[[Path], int] = free_bytes
    ) -> None:
        self._folder = folder
        self._reserve_bytes = reserve_bytes
        self._free = free
        self._bytes_ps = FIRST_BYTES_PS

    def measure(self, episode: Path, duration_ns: int) -> None:
        """Learn the rate from an episode that has lasted so long; raises OSError."""
        if duration_ns >= MEASURED_NS:
            size = sum(entry.stat().st_size for entry in episode.iterdir())
            self._bytes_ps = max(1.0, size * NS_PER_S / duration_ns)

    def left_s(self) -> float:
        """Time until only the reserve is left, 0 at the least; raises OSError."""
        return max(0.0, (self._free(self._folder) - self._reserve_bytes) / self._bytes_ps)

    @property
    def may_begin(self) -> bool:
        """There is room for another episode; raises OSError."""
        return self.left_s() >= LEAST_S

    @property
    def is_full(self) -> bool:
        """Only the reserve is left; raises OSError."""
        return self.left_s() == 0.0
