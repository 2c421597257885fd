"""Memory, descriptors and threads of a process, and whether they grow."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

SETTLED = 0.3
"""Part of a soak after which everything that is needed has been loaded and allocated."""


class Usage(NamedTuple):
    """What a process holds."""

    rss_mb: float
    descriptors: int
    threads: int


def read_usage(pid: int) -> Usage:
    """What a process of this computer holds now.

    Raises:
        OSError: there is no such process.
    """
    folder = Path(f"/proc/{pid}")
    fields = dict(
        line.split(":", 1) for line in (folder / "status").read_text().splitlines() if ":" in line
    )
    return Usage(
        rss_mb=int(fields["VmRSS"].split()[0]) / 1024,
        descriptors=sum(1 for _ in (folder / "fd").iterdir()),
        threads=int(fields["Threads"]),
    )


def growth(samples: Sequence[Usage]) -> Usage:
    """From the first settled sample to the last: the medians of the first and last third after it.

    Medians, because a sample may fall into a moment in which a file or a thread is in use.
    """
    settled = samples[round(len(samples) * SETTLED) :]
    third = max(len(settled) // 3, 1)
    first, last = settled[:third], settled[-third:]
    return Usage(
        rss_mb=median([usage.rss_mb for usage in last]) - median([usage.rss_mb for usage in first]),
        descriptors=round(
            median([usage.descriptors for usage in last])
            - median([usage.descriptors for usage in first])
        ),
        threads=round(
            median([usage.threads for usage in last]) - median([usage.threads for usage in first])
        ),
    )
