"""Scheduling of this process and its threads, as far as the system permits."""

import gc
import os
import sys

SWITCH_INTERVAL_S = 0.0005
"""Longest time that another Python thread may hold the interpreter while the action loop waits.
Python's default, 5 ms, is half a period at 100 Hz."""
FIFO_PRIORITY = 10
"""Above every ordinary thread, below the kernel's own."""


def settle_process() -> None:
    """Prepare the interpreter for deadlines; call once everything is built, before the flight."""
    gc.collect()
    gc.freeze()  # what was built stays: no collection walks through it in flight
    sys.setswitchinterval(SWITCH_INTERVAL_S)


def settle_thread(*, realtime: bool, cpu: int | None) -> str | None:
    """Schedule the calling thread; returns a message about what was refused, or None."""
    if not hasattr(os, "sched_setaffinity"):
        refusal = "this system cannot pin threads: leave out --action-cpu and --vision-cpu"
        return None if cpu is None else refusal
    has_other_cpus = len(os.sched_getaffinity(0)) > 1
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError as error:
            return f"cannot run on CPU {cpu} ({error.strerror}); it runs where the system puts it"
    # On a single CPU a slow policy would leave nothing to the thread that watches over it.
    if realtime and has_other_cpus:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(FIFO_PRIORITY))
        except PermissionError:
            return (
                "the action loop has no real-time scheduling, so others may delay it: allow it "
                "with ulimit -r 10 or CAP_SYS_NICE, or use --no-realtime"
            )
    return None
