"""Scheduling and memory locking of this process and its threads, as far as the system permits."""

import ctypes
import gc
import os
import platform
import sys
from contextlib import suppress
from pathlib import Path

from mavbridge.core.errors import UserError

SWITCH_INTERVAL_S = 0.0005
"""Longest time that another Python thread may hold the interpreter lock while the policy loop
waits. Python's default, 5 ms, is half a period at 100 Hz."""
GUARD_FIFO_PRIORITY = 10
"""Above all ordinary threads, below the kernel's own."""
ACTION_FIFO_PRIORITY = 5
"""Below the guard: the guard sends on time, however long an inference takes."""
OOM_SCORE = 500
"""oom_score_adj of the flight process (proc(5), at most 1000): the kernel kills it before the
guard, whose value stays 0. 500 counts as half of the machine's memory."""
_MCL_CURRENT, _MCL_FUTURE = 1, 2
"""From <sys/mman.h>, equal on Linux for x86 and ARM, and on macOS."""


def require_supported_system() -> None:
    """Raise UserError on a system where a guard cannot outlive the flight process. Call first."""
    if platform.system() not in ("Linux", "Darwin"):
        raise UserError(
            f"mavbridge does not fly from {platform.system() or 'this system'}: use Linux (with "
            "real-time scheduling) or macOS, or on Windows a Linux virtual machine"
        )


def settle_process() -> None:
    """Prepare the interpreter for deadlines. Call after construction, before the flight.

    Garbage collection stays enabled, so that cycles do not accumulate for hours. Existing objects
    are frozen, so that a collection only walks those of the flight.
    """
    gc.collect()
    gc.freeze()
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def prepare_to_die_first() -> None:
    """Let the kernel kill this process before the guard, and without a core dump.

    The guard learns of the death when the process begins to exit, which is after any dump.
    Children inherit both settings, so start the guard before. Settings that the system refuses stay
    unchanged.
    """
    with suppress(OSError):  # no such file on macOS
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE))
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))


def settle_guard(*, realtime: bool) -> str | None:
    """Prepare the guard process, which has one thread. Call after construction.

    Its memory is locked in RAM, and ``realtime`` schedules it before all ordinary threads; its
    children are ordinary again. Garbage collection stays enabled, as in ``settle_process``.

    Returns:
        What the system refused and how to allow it, or None.
    """
    gc.collect()
    gc.freeze()
    refusals = [
        _use_fifo(GUARD_FIFO_PRIORITY, "the guard") if realtime else None,
        _lock_memory(),
    ]
    return "; ".join(filter(None, refusals)) or None


def settle_thread() -> str | None:
    """Schedule the calling thread of the flight process; return what was refused, or None."""
    # On a single CPU a slow policy would leave nothing to the thread that watches over it.
    if usable_cores() == 1:
        return None
    # Threads that the policy starts are ordinary again, or several could hold every CPU.
    return _use_fifo(ACTION_FIFO_PRIORITY, "the policy")


def usable_cores() -> int:
    """Return the number of CPU cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _use_fifo(priority: int, who: str) -> str | None:
    lacking = f"{who} has no real-time scheduling, so others may delay it"
    if not hasattr(os, "SCHED_RESET_ON_FORK"):
        return f"{lacking}: {platform.system()} has no SCHED_FIFO for a process, use Linux"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except OSError:
        cure = "allow it with ulimit -r 10 or CAP_SYS_NICE, or set scheduling.realtime=false"
        return f"{lacking}: {cure}"
    return None


def _lock_memory() -> str | None:
    """Lock all present and future memory in RAM.

    Done only without a limit for this process: under a limit, an allocation in flight could fail.
    Linux grants unlimited locking to CAP_IPC_LOCK alone unless a limit is set (mlock(2)).
    """
    lacking = "the guard's memory is not locked, so it may wait for the disk"
    if platform.system() != "Linux":
        return f"{lacking}: {platform.system()} cannot lock it, use Linux"
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    is_unlimited = hard == resource.RLIM_INFINITY
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (hard if is_unlimited else 0, hard))
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0:
        return None
    problem = os.strerror(ctypes.get_errno())
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (soft, hard))
    return f"{lacking} ({problem}): allow it with ulimit -l unlimited or CAP_IPC_LOCK"
