"""``mavbridge check``: all rows, the table and the JSON."""

import sys
from collections.abc import Iterator
from functools import partial
from multiprocessing import TimeoutError as PoolTimeoutError
from multiprocessing import get_context
from pathlib import Path

from mavbridge.camera.open import NO_CAMERA
from mavbridge.commands.check.camera import CameraNeeds, camera_rows
from mavbridge.commands.check.policy import check_policy
from mavbridge.commands.check.rows import CheckRow, as_document, overall, print_check
from mavbridge.commands.check.soak import Soak, soak
from mavbridge.commands.check.vehicle import check_vehicle
from mavbridge.commands.config import NO_POLICY, CheckConfig
from mavbridge.commands.output import print_status, text_console, write_json
from mavbridge.config.flight import CameraConfig, FlyConfig
from mavbridge.config.policy import Rates
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import ExitCode, MavbridgeError
from mavbridge.core.files import as_json, empty_folders_removed, require_writable
from mavbridge.core.realtime import settle_guard, usable_cores
from mavbridge.flight.checks import file_checks, output_folders
from mavbridge.flight.plan import FlightPlan
from mavbridge.flight.policies import looks_at_images, require_images
from policy.contract import Contract
from policy.preprocess import least_source_px

STDOUT = Path("-")
NO_VEHICLE = "none"
_CORES = 2
"""One core for the guard and one for the policy, so that neither delays the other."""
_TRIAL_S = 20
"""Time in which a new process must have tried the rights of the guard."""
_camera_row = partial(CheckRow, "camera", "cameras")
_computer_row = partial(CheckRow, "computer")


def check(config: CheckConfig) -> int:
    """Check everything that a flight needs, print the table; return the exit status."""
    is_on_stdout = config.json == STDOUT
    if not is_on_stdout:
        require_writable(config.json, "--json")
    flight, clock = config.flight, MonotonicClock()
    if flight.policy.policy != NO_POLICY:
        print_status(f"loading the policy, then running it for {config.timing:g} s")
    policy, plan = check_policy(flight, clock, timing_s=config.timing)
    brings_camera = config.soak is not None and flight.camera == CameraConfig()
    cameras = [] if brings_camera else _check_cameras(flight, plan, clock)
    if flight.link.connect == NO_VEHICLE:
        rows = [CheckRow("link", "vehicle", "none", "none for this check")]
    else:
        print_status(f"listening to the vehicle on {flight.link.connect}")
        rows = check_vehicle(flight, plan, clock)
    rows += [*cameras, *policy, *_computer_rows(flight.rates), *_file_rows(flight)]
    soaked: Soak | None = None
    if config.soak is not None:
        print_status(f"flying the bundled vehicle for {config.soak:g} s")
        try:
            soaked = soak(flight, clock, duration_s=config.soak)
            row = soaked.row()
        except MavbridgeError as error:
            row = _computer_row("soak", "not flown", no_go=str(error))
        rows.append(row)
    document = as_document(rows) | {"soak": soaked}
    if not is_on_stdout:
        write_json(config.json, document)
    print_check(rows, text_console(stderr=is_on_stdout))
    if is_on_stdout:
        sys.stdout.write(as_json(document))
    return ExitCode.NOT_FLOWN if overall(rows) == "no-go" else ExitCode.DONE


def _computer_rows(rates: Rates) -> Iterator[CheckRow]:
    """Yield rows about cores, real-time scheduling and locked memory."""
    cores = usable_cores()
    shared = "guard and policy share one core: a slow policy delays the sticks"
    yield _computer_row("cores", str(cores), f"{_CORES} or more", "" if cores >= _CORES else shared)
    try:  # in a process of its own, so that this one is not affected
        with get_context("spawn").Pool(1) as pool:
            trial = pool.apply_async(settle_guard, kwds={"realtime": rates.realtime})
            refused = trial.get(_TRIAL_S) or ""
    except PoolTimeoutError:
        refused = f"the rights of the guard could not be tried: no answer in {_TRIAL_S} s"
    except OSError as error:
        refused = f"the rights of the guard could not be tried: {error}"
    yield _computer_row(
        "rights of the guard",
        "refused in part" if refused else "granted",
        "SCHED_FIFO and locked memory" if rates.realtime else "locked memory",
        refused,
    )


def _file_rows(config: FlyConfig) -> Iterator[CheckRow]:
    """Yield a row on each file that the flight uses, and on its viewer."""
    with empty_folders_removed(*output_folders(config)):
        for name, value, check_file in file_checks(config):
            try:
                check_file()
                yield _computer_row(name, str(value))
            except MavbridgeError as error:
                yield _computer_row(name, str(value), no_go=str(error))


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
        rates_hz = (config.rates.visual_rate,) * len(sources)
        max_age_s = contract.max_feature_age_s
    else:
        contract = plan.contract
        names, sources = contract.cameras, config.camera.sources_of(contract.cameras)
        rates_hz = plan.image_rates_hz
        max_age_s = plan.start_limits.feature_ns / NS_PER_S
    return [
        CameraNeeds(
            name=name if len(names) > 1 else "",
            source=source,
            rate_hz=rate_hz,
            size_px=least_source_px(contract),
            max_age_s=max_age_s,
            is_flown_by=looks_at_images(config),
            is_depth=None if plan is None else contract.is_depth,
        )
        for name, source, rate_hz in zip(names, sources, rates_hz, strict=False)
    ]
