"""Processes of a flight, found and watched from outside."""

import os
import select
import signal
from contextlib import suppress
from pathlib import Path

from sitl.clock import Clock

MEMORY = Path("/dev/shm")  # noqa: S108 - the system's place for shared memory


class StageError(Exception):
    """A flight did not get as far as its fault, or did not end."""


class Process:
    """A process of which nobody here is the parent, such as the guard of a killed bridge."""

    def __init__(self, pid: int, clock: Clock) -> None:
        self.pid = pid
        self._clock = clock
        self._fd = os.pidfd_open(pid)

    def has_ended(self, timeout_s: float) -> bool:
        """Wait for its end; a zombie has ended."""
        return bool(select.select([self._fd], [], [], timeout_s)[0])

    def kill(self, number: signal.Signals) -> int:
        """Send a signal; returns the moment."""
        at_ns = self._clock.now_ns()
        with suppress(ProcessLookupError):
            signal.pidfd_send_signal(self._fd, number)
        return at_ns

    def peak_memory_mb(self) -> float:
        """Largest resident set so far."""
        status = Path(f"/proc/{self.pid}/status").read_text()
        (line,) = [line for line in status.splitlines() if line.startswith("VmHWM:")]
        return int(line.split()[1]) / 1024

    def close(self) -> None:
        """End it if it still runs."""
        self.kill(signal.SIGKILL)
        os.close(self._fd)


def processes_with(variable: str) -> list[tuple[int, str]]:
    """Id and command of each running process that began with this ``NAME=value`` around it."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if variable.encode() in (entry / "environ").read_bytes().split(b"\0"):
                command = (entry / "cmdline").read_bytes().replace(b"\0", b" ")
                found.append((int(entry.name), command.decode(errors="replace").strip()))
    return found


def mapped_memory(pid: int) -> set[str]:
    """Names in ``MEMORY`` that a process has mapped, also those that are removed already."""
    maps = Path(f"/proc/{pid}/maps").read_text().splitlines()
    paths = [Path(line.split()[5]) for line in maps if f" {MEMORY}/" in line]
    return {path.name for path in paths}


def child_of(parent_pid: int, text: bytes) -> int:
    """The child process whose command line contains a text.

    Raises:
        StageError: it has no such child.
    """
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
            command = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if parent == parent_pid and text in command:
            return int(entry.name)
    raise StageError(f"process {parent_pid} has no child with {text!r} in its command line")
