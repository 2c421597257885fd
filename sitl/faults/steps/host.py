"""Steps of the computer and its processes, beyond what ``steps`` has."""

import os
import resource
import signal
import subprocess
import sys
from dataclasses import dataclass
from typing import Literal, TypeAlias

from sitl import UsageError
from sitl.faults.stage.stage import ProcessName, Stage

BUSY = "while True: pass"


@dataclass(frozen=True, kw_only=True)
class Limit:
    """The kernel gives a process no more of something (``prlimit(2)``)."""

    of: Literal["NOFILE", "FSIZE", "AS"]
    """Open files; bytes of a file, beyond which a write fails as on a full disk; address space."""
    at: int
    to: ProcessName = "flight"

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        at_ns, number = stage.clock.now_ns(), getattr(resource, f"RLIMIT_{self.of}")
        pid = stage.pid_of(self.to)
        _, most = resource.prlimit(pid, number)
        resource.prlimit(pid, number, (self.at, most))
        return at_ns


@dataclass(frozen=True, kw_only=True)
class WallClock:
    """Wall time jumps by an hour, for a bridge that runs with ``catalogue/stepped_clock``."""

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        (stage.folder / "stepped").touch()
        return stage.clock.now_ns()


@dataclass(frozen=True, kw_only=True)
class ViewerFault:
    """The viewer stops reading, or is gone."""

    signal: Literal["SIGSTOP", "SIGKILL"]

    def perform(self, stage: Stage) -> int:
        """Returns the moment."""
        if stage.viewer is None:
            raise UsageError("this flight has no viewer: --rerun {viewer} among its flags")
        at_ns = stage.clock.now_ns()
        stage.viewer.process.send_signal(signal.Signals[self.signal])
        return at_ns


@dataclass(frozen=True, kw_only=True)
class Load:
    """Other programs want every core for a while."""

    s: float

    def perform(self, stage: Stage) -> int:
        """Returns the moment at which it began."""
        at_ns = stage.clock.now_ns()
        cores = range(os.cpu_count() or 1)
        hogs = [subprocess.Popen([sys.executable, "-c", BUSY]) for _ in cores]
        stage.observe(self.s)
        for hog in hogs:
            hog.kill()
            hog.wait()
        return at_ns


@dataclass(frozen=True, kw_only=True)
class Ended:
    """Wait until the policy has put the sticks down by itself."""

    def perform(self, stage: Stage) -> int:
        """Returns the moment of its last stick."""
        return stage.last_lean_ns()


HostStep: TypeAlias = Limit | WallClock | ViewerFault | Load | Ended
HOST_KINDS = {
    "limit": Limit,
    "wall clock": WallClock,
    "viewer": ViewerFault,
    "load": Load,
    "ended": Ended,
}
