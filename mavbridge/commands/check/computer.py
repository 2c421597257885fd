"""This computer: rows of the check, its description, and what processes and threads have used."""

import os
import platform
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from multiprocessing import TimeoutError as PoolTimeoutError
from multiprocessing import get_context
from pathlib import Path

from mavbridge.commands.check.rows import CheckRow
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.provenance import versions
from mavbridge.core.realtime import settle_guard, usable_cores

PROC, SYS = Path("/proc"), Path("/sys")
_CORES = 2
"""One core for the guard and one for the policy, so that neither delays the other."""
_GOVERNOR = "devices/system/cpu/cpu0/cpufreq/scaling_governor"
_STEAL_FIELD = 8
"""Index of "steal" in the line "cpu": cpu user nice system idle iowait irq softirq steal."""
_TRIAL_S = 20
"""Time in which a new process must have tried the rights of the guard."""
_row = partial(CheckRow, "computer")


def computer_rows(rates: Rates) -> Iterator[CheckRow]:
    """Yield rows about cores, real-time scheduling and locked memory."""
    cores = usable_cores()
    shared = "guard and policy share one core: a slow policy delays the sticks"
    yield _row("cores", str(cores), f"{_CORES} or more", "" if cores >= _CORES else shared)
    try:  # in a process of its own, so that this one is not affected
        with get_context("spawn").Pool(1) as pool:
            trial = pool.apply_async(settle_guard, kwds={"realtime": rates.realtime})
            refused = trial.get(_TRIAL_S) or ""
    except PoolTimeoutError:
        refused = f"the rights of the guard could not be tried: no answer in {_TRIAL_S} s"
    except OSError as error:
        refused = f"the rights of the guard could not be tried: {error}"
    yield _row(
        "rights of the guard",
        "refused in part" if refused else "granted",
        "SCHED_FIFO and locked memory" if rates.realtime else "locked memory",
        refused,
    )


@dataclass(frozen=True, kw_only=True)
class Computer:
    """Description of a computer; an empty text is unknown."""

    model: str
    """Name of the board, as a Raspberry Pi or a Jetson tells it."""
    cpu: str
    machine: str
    """Architecture, as x86_64 or aarch64."""
    cores: int
    """Cores that this process may use."""
    kernel: str
    governor: str
    """Governor of the clock of CPU 0."""
    versions: dict[str, str]
    """Versions of Python, mavbridge and the packages that compute."""


def this_computer() -> Computer:
    """Describe this computer."""
    lines = _text(PROC / "cpuinfo").splitlines()
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return Computer(
        model=_text(PROC / "device-tree/model").strip("\0"),
        cpu=next(names, platform.processor() or "unknown processor"),
        machine=platform.machine(),
        cores=usable_cores(),
        kernel=platform.release(),
        governor=_text(SYS / _GOVERNOR),
        versions=versions(),
    )


def hottest_c() -> float | None:
    """Return the highest temperature that the kernel tells [degrees Celsius]; None: it tells
    none."""
    texts = (_text(zone) for zone in SYS.glob("class/thermal/thermal_zone*/temp"))
    return max((int(text) / 1000 for text in texts if text.lstrip("-").isdigit()), default=None)


@dataclass(frozen=True, kw_only=True)
class Usage:
    """Processor times up to a moment [ns], each since an arbitrary start; 0: not told."""

    at_ns: int
    used_ns: dict[str, int]
    """Time in which "flight" (this process), "guard", and, as "flight/NAME", each thread of this
    process ran; "flight/others" are threads of libraries."""
    guard_waited_ns: int
    """Time in which the guard was runnable but not on a processor."""
    host_ns: int
    """Time in which the hypervisor gave this machine's processors to others."""


def read_usage(clock: Clock, guard_pid: int) -> Usage:
    """Read the counters of the kernel (proc_stat(5), sched-stats.rst)."""
    guard_ns, waited_ns = _scheduled_ns(PROC / str(guard_pid))
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    used_ns = {"flight": time.process_time_ns(), "guard": guard_ns}
    for task in (PROC / "self/task").glob("*"):
        name = f"flight/{names.get(int(task.name), 'others')}"
        used_ns[name] = used_ns.get(name, 0) + _scheduled_ns(task)[0]
    steal = _text(PROC / "stat").partition("\n")[0].split()[_STEAL_FIELD:][:1] or ["0"]
    return Usage(
        at_ns=clock.now_ns(),
        used_ns=used_ns,
        guard_waited_ns=waited_ns,
        host_ns=int(steal[0]) * NS_PER_S // os.sysconf("SC_CLK_TCK"),
    )


def _scheduled_ns(process: Path) -> tuple[int, int]:
    """Return the times for which a process or thread ran, and waited for a processor; or zeros."""
    ran, waited = (*_text(process / "schedstat").split()[:2], "0", "0")[:2]
    return int(ran), int(waited)


def _text(path: Path) -> str:
    """Return the text of a small system file; empty if there is none."""
    try:
        return path.read_text().strip()
    except OSError:
        return ""
