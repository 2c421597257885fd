"""Processes of a flight, found and watched from outside, and their leftovers."""

import os
import select
import signal
import threading
from collections.abc import Callable, Set
from contextlib import suppress
from pathlib import Path

from sitl.clock import Clock

MEMORY = Path("/dev/shm")
LEFT_WAIT_S, LEFT_POLL_S = 10.0, 0.1
"""A recorder's writer ends after the processes that feed it."""


class StageError(Exception):
    """A flight did not reach its fault, or did not end."""


class Process:
    """Process that is not a child of this one, such as the guard of a killed bridge."""

    def __init__(self, pid: int, clock: Clock) -> None:
        self.pid = pid
        self._clock = clock
        self._fd = os.pidfd_open(pid)

    def has_ended(self, timeout_s: float) -> bool:
        """Wait for its end; return True if it has ended. A zombie has ended."""
        return bool(select.select([self._fd], [], [], timeout_s)[0])

    def kill(self, number: signal.Signals) -> int:
        """Send a signal; return the time."""
        at_ns = self._clock.now_ns()
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._fd, number)
        return at_ns

    def peak_memory_mb(self) -> float:
        lines = Path(f"/proc/{self.pid}/status").read_text().splitlines()
        (peak,) = [line for line in lines if line.startswith("VmHWM:")]
        return int(peak.split()[1]) / 1024

    def close(self) -> None:
        """Kill it if it still runs."""
        self.kill(signal.SIGKILL)
        os.close(self._fd)


def processes_with(variable: str) -> list[tuple[int, str]]:
    """Return id and command of each running process started with ``NAME=value`` set."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if variable.encode() in (entry / "environ").read_bytes().split(b"\0"):
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ")
                found.append((int(entry.name), command.decode(errors="replace").strip()))
    return found


def mapped_memory(pid: int) -> set[str]:
    """Return the names in ``MEMORY`` that a process has mapped, including names already removed."""
    maps = Path(f"/proc/{pid}/maps").read_text().splitlines()
    paths = [Path(line.split()[5]) for line in maps if f" {MEMORY}/" in line]
    return {path.name for path in paths}


def child_of(parent_pid: int, text: bytes) -> int:
    """Return the child process whose command line contains a text."""
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            command = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == parent_pid and text in command:
            return int(entry.name)
    raise StageError(f"process {parent_pid} has no child with {text!r} in its command line")


def thread_names() -> frozenset[str]:
    """Return the names of this process's threads."""
    return frozenset(thread.name for thread in threading.enumerate())


def leaks(
    processes: Callable[[], list[tuple[int, str]]],
    memory: Set[str],
    temporary: Path,
    threads_before: Set[str],
) -> list[str]:
    """Return the processes, shared memory, files and threads that a flight has left behind.

    Waits up to ``LEFT_WAIT_S`` for those that are still ending.
    """
    pause, left = threading.Event(), [""]
    for _ in range(1 + round(LEFT_WAIT_S / LEFT_POLL_S)):
        left = [f"process {pid}: {name}" for pid, name in processes()]
        left += [f"shared memory {name}" for name in memory if (MEMORY / name).exists()]
        left += [f"temporary {path.name}" for path in temporary.iterdir()]
        left += [f"thread {name}" for name in sorted(thread_names() - threads_before)]
        if not left or not LEFT_WAIT_S:
            break
        pause.wait(LEFT_POLL_S)
    return left
