"""Protects the process's signal handlers from an engine that meddles with where they run.

OpenVINO's CPU plugin gives the thread that loads it an alternate signal stack, and frees that
memory with the last of its objects. Python's handlers ask for the alternate stack, so the next
Ctrl-C would be handled in memory that is gone, and end the process with the sticks still held.
(Seen with 2026.4: ``sigaltstack`` after loading, a segmentation fault in ``kill`` after freeing.)
"""

import ctypes
import sys
from collections.abc import Iterator
from contextlib import contextmanager

_SS_DISABLE = 2
"""bits/ss_flags.h: no alternate stack."""


class _StackT(ctypes.Structure):
    """stack_t of Linux, see sigaltstack(2)."""

    _fields_ = (
        ("ss_sp", ctypes.c_void_p),
        ("ss_flags", ctypes.c_int),
        ("ss_size", ctypes.c_size_t),
    )


@contextmanager
def signal_stack_kept() -> Iterator[None]:
    """Give the calling thread its alternate signal stack back, or none if it had none."""
    if sys.platform != "linux":
        yield
        return
    sigaltstack = ctypes.CDLL(None, use_errno=True).sigaltstack
    before = _StackT()
    sigaltstack(None, ctypes.byref(before))
    try:
        yield
    finally:
        if sigaltstack(ctypes.byref(before), None) != 0:
            # Too small for what the CPU must save by now (AMX): none is better than a freed one.
            none = _StackT(ss_sp=None, ss_flags=_SS_DISABLE, ss_size=0)
            sigaltstack(ctypes.byref(none), None)
