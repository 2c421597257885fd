"""This computer: rows of the check, its description, and what processes and threads have used."""

import os
import platform
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from mavbridge.commands.check.rows import CheckRow
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_S, Clock
from mavbridge.core.processes import child_environment
from mavbridge.core.provenance import versions
from mavbridge.core.realtime import usable_cores

PROC, SYS = Path("/proc"), Path("/sys")
_CLOCK_SOURCE = SYS / "devices/system/clocksource/clocksource0/current_clocksource"
_SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
"""Clock sources read from a device, which takes a microsecond or more, or that only tick."""
_CORES = 2
"""One core for the guard and one for the policy, so that neither delays the other."""
_RIGHTS_TIMEOUT_S = 10.0
_TRY_RIGHTS = """
import sys
from collections.abc import Iterator
from functools import partial
from mavbridge.core.realtime import settle_guard, settle_thread
cpus = [int(word) if word else None for word in sys.argv[2:]]
realtime = sys.argv[1] == "yes"
refusals = [settle_guard(realtime=realtime, cpu=cpus[0])]
refusals += [settle_thread(realtime=False, cpu=cpu) for cpu in cpus[1:]]
print("; ".join(filter(None, refusals)))
"""
"""Requests the guard's rights in a separate process, so that this one is not affected."""
_GOVERNOR = SYS / "devices/system/cpu/cpu0/cpufreq/scaling_governor"
_STEAL_FIELD = 8
"""Index of "steal" in the line "cpu": cpu user nice system idle iowait irq softirq steal."""
_row = partial(CheckRow, "computer")


def computer_rows(rates: Rates) -> Iterator[CheckRow]:
    """Yield rows about clock source, cores, real-time scheduling and locked memory."""
    source = _text(_CLOCK_SOURCE)  # no such file on macOS, or in some containers
    slow = (
        f"the clock source {source} is slow to read or coarse: stamps are late by its time; see "
        "current_clocksource in the kernel's documentation"
    )
    yield _row(
        "clock",
        source or f"not told by {platform.system()}",
        "one that the processor reads by itself, such as tsc",
        slow if source in _SLOW_CLOCKS else "",
    )
    cores = usable_cores()
    shared = "guard and policy share one core: a slow policy delays the sticks"
    yield _row("cores", str(cores), f"{_CORES} or more", "" if cores >= _CORES else shared)
    refused = _refused_rights(rates)
    yield _row(
        "rights of the guard",
        "refused in part" if refused else "granted",
        "SCHED_FIFO and locked memory" if rates.realtime else "locked memory",
        refused,
    )


def _refused_rights(rates: Rates) -> str:
    """Return the rights that this system refuses to the guard; empty if all are granted."""
    words = ["yes" if rates.realtime else "no"]
    cpus = (rates.guard_cpu, rates.action_cpu, rates.vision_cpu)
    words += ["" if cpu is None else str(cpu) for cpu in cpus]
    try:
        tried = subprocess.run(
            [sys.executable, "-c", _TRY_RIGHTS, *words],
            env=child_environment(),
            capture_output=True,
            text=True,
            timeout=_RIGHTS_TIMEOUT_S,
            check=True,
        )
    except (OSError, subprocess.SubprocessError) as error:
        return f"the rights of the guard could not be tried: {error}"
    return tried.stdout.strip()


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
        governor=_text(_GOVERNOR),
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
    flight_ns: int
    """Time in which this process ran."""
    guard_ns: int
    guard_waited_ns: int
    """Time in which the guard was runnable but not on a processor."""
    host_ns: int
    """Time in which the hypervisor gave this machine's processors to others."""
    threads_ns: dict[str, int]
    """Time of each thread of this process by its name; "others" are those of libraries."""


def read_usage(clock: Clock, guard_pid: int) -> Usage:
    """Read the counters of the kernel (proc_stat(5), sched-stats.rst)."""
    guard_ns, waited_ns = _scheduled_ns(PROC / str(guard_pid))
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    threads_ns: dict[str, int] = {}
    for task in (PROC / "self/task").glob("*"):
        name = names.get(int(task.name), "others")
        threads_ns[name] = threads_ns.get(name, 0) + _scheduled_ns(task)[0]
    steal = _text(PROC / "stat").partition("\n")[0].split()[_STEAL_FIELD:][:1] or ["0"]
    return Usage(
        at_ns=clock.now_ns(),
        flight_ns=time.process_time_ns(),
        guard_ns=guard_ns,
        guard_waited_ns=waited_ns,
        host_ns=int(steal[0]) * NS_PER_S // os.sysconf("SC_CLK_TCK"),
        threads_ns=threads_ns,
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
