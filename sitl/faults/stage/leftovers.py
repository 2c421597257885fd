"""What a flight has left behind: processes, threads, shared memory and temporary files."""

import threading
from collections.abc import Set

from sitl.faults.stage.processes import MEMORY
from sitl.faults.stage.stage import Stage

WAIT_S = 10.0
"""A recorder's writer ends after the processes that fed it."""
POLL_S = 0.1


def thread_names() -> frozenset[str]:
    """Threads of this process now."""
    return frozenset(thread.name for thread in threading.enumerate())


def leftovers(stage: Stage, threads_before: Set[str]) -> list[str]:
    """Name what a flight has left; waits up to ``WAIT_S`` for what is still ending.

    Args:
        stage: after its block, while its folder exists.
        threads_before: ``thread_names`` before the block.
    """
    pause, left = threading.Event(), _find(stage, threads_before)
    for _ in range(round(WAIT_S / POLL_S)):
        if not left:
            break
        pause.wait(POLL_S)
        left = _find(stage, threads_before)
    return left


def _find(stage: Stage, threads_before: Set[str]) -> list[str]:
    left = [f"process {pid}: {name}" for pid, name in stage.processes()]
    left += [f"shared memory {name}" for name in stage.memory if (MEMORY / name).exists()]
    left += [f"temporary {path.name}" for path in stage.temporary.iterdir()]
    return left + [f"thread {name}" for name in sorted(thread_names() - threads_before)]
