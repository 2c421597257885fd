"""``mavbridge check``: checks whether a flight can begin, without flying."""

import sys
from pathlib import Path

from mavbridge.commands.check.camera import check_cameras
from mavbridge.commands.check.computer import Soak, check_soak, computer_rows, file_rows
from mavbridge.commands.check.policy import check_policy
from mavbridge.commands.check.rows import as_document, overall, print_check
from mavbridge.commands.check.vehicle import check_vehicle
from mavbridge.commands.config import CheckConfig
from mavbridge.commands.output import text_console, write_json
from mavbridge.config.flight import CameraConfig
from mavbridge.core.clock import MonotonicClock
from mavbridge.core.errors import ExitCode
from mavbridge.core.files import as_json, require_writable

STDOUT = Path("-")


def check(config: CheckConfig) -> int:
    """Check everything that a flight needs, print the table; return the exit status."""
    is_on_stdout = config.json == STDOUT
    if not is_on_stdout:
        require_writable(config.json, "--json")
    flight, clock = config.flight, MonotonicClock()
    policy, plan = check_policy(flight, clock, timing_s=config.timing)
    brings_camera = config.soak is not None and flight.camera == CameraConfig()
    cameras = [] if brings_camera else check_cameras(flight, plan, clock)
    rows = check_vehicle(flight, plan, clock)
    rows += [*cameras, *policy, *computer_rows(flight), *file_rows(flight)]
    soaked: Soak | None = None
    if config.soak is not None:
        row, soaked = check_soak(flight, clock, duration_s=config.soak)
        rows.append(row)
    document = as_document(rows) | {"soak": soaked}
    if not is_on_stdout:
        write_json(config.json, document)
    print_check(rows, text_console(stderr=is_on_stdout))
    if is_on_stdout:
        sys.stdout.write(as_json(document))
    return ExitCode.NOT_FLOWN if overall(rows) == "no-go" else ExitCode.DONE
