"""What the process does for its deadlines, each where the system permits it."""

import gc
import os
import sys

SWITCH_INTERVAL_S = 0.0005
"""Longest that a thread holding the interpreter may keep the action loop waiting; Python's default
is ten times that, half a tick."""
FIFO_PRIORITY = 10
"""Above every ordinary thread, below the kernel's own."""


def settle_process() -> None:
    """After everything is built and before anything flies."""
    gc.collect()
    gc.freeze()  # what was built stays: no collection walks through it in flight
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def settle_thread(*, realtime: bool, cpu: int | None) -> str | None:
    """Scheduling of the calling thread; returns what was refused and what to do, or None."""
    if not hasattr(os, "sched_setaffinity"):
        return None if cpu is None else "this system cannot place threads: leave the CPUs to it"
    has_company = len(os.sched_getaffinity(0)) > 1
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError as error:
            return f"cannot run on CPU {cpu} ({error.strerror}); it runs where the system puts it"
    # On a single CPU a slow policy would leave nothing to the thread that watches over it.
    if realtime and has_company:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        except PermissionError:
            return (
                "the action loop has no real-time scheduling, so others may delay it: allow it "
                "with ulimit -r 10 or CAP_SYS_NICE, or say --no-realtime"
            )
    return None
