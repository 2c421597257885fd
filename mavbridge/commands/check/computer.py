"""Rows about this computer: its clock, its cores, and what it permits to the gate."""

import os
import platform
import subprocess
import sys
from pathlib import Path

from mavbridge.commands.check.rows import Row
from mavbridge.config.rates import Rates
from mavbridge.core.processes import child_environment

_CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
_SLOW_CLOCKS = ("hpet", "acpi_pm", "jiffies", "refined-jiffies", "pit")
"""Clock sources that are read from a device, in a microsecond or more, or only tick."""
_CORES = 2
"""The gate beside the policy, so that neither delays the other."""
_RIGHTS_TIMEOUT_S = 10.0
_TRY_RIGHTS = """
import sys
from mavbridge.core.realtime import settle_gate, settle_thread
cpus = [int(word) if word else None for word in sys.argv[2:]]
realtime = sys.argv[1] == "yes"
refusals = [settle_gate(realtime=realtime, cpu=cpus[0])]
refusals += [settle_thread(realtime=False, cpu=cpu) for cpu in cpus[1:]]
print("; ".join(filter(None, refusals)))
"""
"""A process of its own asks as the gate does, and ends: nothing of it stays with this one."""


def computer_rows(rates: Rates) -> list[Row]:
    """Clock source, cores, real-time scheduling and locked memory."""
    return [_clock_row(), _cores_row(), _rights_row(rates)]


def _clock_row() -> Row:
    try:
        source = _CLOCK_SOURCE.read_text().strip()
    except OSError:  # no such file on macOS, or in some containers
        source = ""
    is_slow = source in _SLOW_CLOCKS
    return Row(
        area="computer",
        name="clock",
        found=source or f"not told by {platform.system()}",
        expected="one that the processor reads by itself, such as tsc",
        verdict="warn" if is_slow else "go",
        advice=f"the clock source {source} is slow to read or coarse: stamps are late by its time; "
        "see current_clocksource in the kernel's documentation"
        if is_slow
        else "",
    )


def _cores_row() -> Row:
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    return Row(
        area="computer",
        name="cores",
        found=str(cores),
        expected=f"{_CORES} or more",
        verdict="go" if cores >= _CORES else "warn",
        advice=""
        if cores >= _CORES
        else "gate and policy share one core: a slow policy delays the sticks",
    )


def _rights_row(rates: Rates) -> Row:
    words = ["yes" if rates.realtime else "no"]
    cpus = (rates.gate_cpu, rates.action_cpu, rates.vision_cpu)
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
        refused = tried.stdout.strip()
    except (OSError, subprocess.SubprocessError) as error:
        refused = f"the rights of the gate could not be tried: {error}"
    wanted = "SCHED_FIFO and locked memory" if rates.realtime else "locked memory"
    return Row(
        area="computer",
        name="rights of the gate",
        found="refused in part" if refused else "granted",
        expected=wanted,
        verdict="warn" if refused else "go",
        advice=refused,
    )
