"""Why a slot of the action loop was missed: pure, from stamps and counters of two ticks."""

from dataclasses import dataclass
from typing import Literal, get_args

Cause = Literal["host", "kernel", "gc", "inference", "loop", "lock"]
CAUSES: tuple[Cause, ...] = get_args(Cause)
"""host: the hypervisor gave our processor to others; kernel: the thread could run and was not put
on a processor; gc: Python's collector; inference: the policy took longer than the period; loop: the
rest of the tick did; lock: the thread was neither running nor runnable, so it waited for the
interpreter lock (or for something inside the policy) until after its slot."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Counters:
    """What is known as a tick ends; all of it only ever grows."""

    stolen_ns: int | None
    """Processor time taken by the host, all processors; None = not known."""
    runnable_ns: int | None
    """Time that the action thread stood in a run queue; None = not known."""
    gc_ns: int
    """Time inside the garbage collector, whichever thread ran it."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Lateness:
    """Two ticks with missed slots between them."""

    overrun_ns: int
    """Wake to wake, less one period."""
    work_ns: int
    """Of the first tick: wake to send."""
    predict_ns: int
    """Of the first tick: the policy's part."""
    period_ns: int
    before: Counters
    after: Counters


def attribute(lateness: Lateness) -> Cause:
    """The first cause, outermost first, that explains at least half of the overrun.

    Time that the host or the kernel took is inside everything else that was slow meanwhile, so
    they come first. What no counter explains was work if the first tick outlasted its period, and
    waiting if it did not.
    """
    before, after = lateness.before, lateness.after
    outside: tuple[tuple[Cause, int], ...] = (
        ("host", _grown(before.stolen_ns, after.stolen_ns)),
        ("kernel", _grown(before.runnable_ns, after.runnable_ns)),
        ("gc", after.gc_ns - before.gc_ns),
    )
    for cause, taken_ns in outside:
        if 2 * taken_ns >= lateness.overrun_ns:
            return cause
    if lateness.work_ns < lateness.period_ns:
        return "lock"
    return "inference" if 2 * lateness.predict_ns >= lateness.work_ns else "loop"


def _grown(before_ns: int | None, after_ns: int | None) -> int:
    return 0 if before_ns is None or after_ns is None else after_ns - before_ns
