"""``mavbridge check``: all rows, the table, and the rows about this computer."""

import json
import os
import platform
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import cv2
from rich.console import Console

from mavbridge.camera.open import NO_CAMERA
from mavbridge.commands.check.camera import CameraNeeds, camera_rows
from mavbridge.commands.check.policy import NO_POLICY, check_policy
from mavbridge.commands.check.rows import CheckRow, as_document, overall, print_check
from mavbridge.commands.check.vehicle import check_vehicle
from mavbridge.commands.config import CheckConfig
from mavbridge.commands.output import print_status
from mavbridge.config.flight import CameraConfig, FlyConfig
from mavbridge.config.rates import Rates
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import ExitCode, MavbridgeError
from mavbridge.core.files import require_writable
from mavbridge.core.processes import child_environment
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.policies import looks_at_images, require_images
from policy.contract import Contract
from policy.preprocess import least_source_px

_CLOCK_SOURCE = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
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
STDOUT = Path("-")
NO_VEHICLE = "none"
_row = partial(CheckRow, "computer")
_camera_row = partial(CheckRow, "camera", "cameras")


def computer_rows(rates: Rates) -> Iterator[CheckRow]:
    """Yield rows about clock source, cores, real-time scheduling and locked memory."""
    try:
        source = _CLOCK_SOURCE.read_text().strip()
    except OSError:  # no such file on macOS, or in some containers
        source = ""
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
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
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


def check(config: CheckConfig) -> int:
    """Check everything that a flight needs, print the table; return the exit status."""
    is_on_stdout = config.json == STDOUT
    if not is_on_stdout:
        require_writable(config.json, "--json")
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    flight, clock = config.flight, MonotonicClock()
    if flight.policy.policy != NO_POLICY:
        print_status(f"loading the policy, then running it for {config.timing:g} s")
    policy, plan = check_policy(flight, clock, timing_s=config.timing)
    cameras = _check_cameras(flight, plan, clock)
    if flight.link.connect == NO_VEHICLE:
        rows = [CheckRow("link", "vehicle", "none", "none for this check")]
    else:
        print_status(f"listening to the vehicle on {flight.link.connect}")
        rows = check_vehicle(flight, plan, clock, echo_test=config.echo_test)
    rows += [*cameras, *policy, *computer_rows(flight.rates)]
    document = json.dumps(as_document(rows), indent=2) + "\n"
    if config.json is not None and not is_on_stdout:
        config.json.write_text(document)
    print_check(rows, Console(stderr=is_on_stdout, highlight=False))
    if is_on_stdout:
        sys.stdout.write(document)
    return ExitCode.NOT_FLOWN if overall(rows) == "no-go" else ExitCode.DONE


def _check_cameras(config: FlyConfig, plan: FlightPlan | None, clock: Clock) -> list[CheckRow]:
    """Return rows on every camera of the flight, or on the flags that do not fit the policy."""
    is_blind = set(config.camera.sources) == {NO_CAMERA}
    if is_blind and config.link.connect == NO_VEHICLE:
        return []  # only this computer is checked
    try:
        require_images(config)
        needs = [] if is_blind else _camera_needs(config, plan)
    except MavbridgeError as error:
        return [_camera_row(" ".join(config.camera.sources), no_go=str(error))]
    if not needs:
        return [_camera_row("none", "none for this flight")]
    print_status("watching the camera")
    return camera_rows(needs, config.camera, clock)


def _camera_needs(config: FlyConfig, plan: FlightPlan | None) -> list[CameraNeeds]:
    """Return the flight's needs of each camera; raise UserError if their names do not fit.

    Without a policy only cameras named by flags are checked.
    """
    if plan is None:
        if config.camera == CameraConfig():
            return []
        contract = Contract()
        names, sources = config.camera.sources, config.camera.sources
        _, most_hz = config.rates.visual_limits_hz
        max_age_s = contract.max_feature_age_s
    else:
        contract = plan.contract
        names, sources = contract.cameras, config.camera.sources_of(contract.cameras)
        most_hz = plan.loops.max_vision_hz
        max_age_s = plan.start_limits.feature_ns / NS_PER_S
    rates_hz = contract.camera_rates_hz or (most_hz,) * len(sources)
    return [
        CameraNeeds(
            name=name if len(names) > 1 else "",
            source=source,
            rate_hz=min(rate_hz, most_hz),
            side_px=least_source_px(contract),
            max_age_s=max_age_s,
            is_flown_by=looks_at_images(config),
            is_depth=None if plan is None else contract.is_depth,
        )
        for name, source, rate_hz in zip(names, sources, rates_hz, strict=False)
    ]
