"""Checks that run before anything slow is loaded."""

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from mavbridge.camera.open import check_camera
from mavbridge.config.flight import FlyConfig, LinkConfig
from mavbridge.core.address import is_reachable, parse_address
from mavbridge.core.course import read_gates
from mavbridge.core.files import require_writable
from mavbridge.flight.policies import policy_request, require_cameras, require_images
from mavbridge.observe.viewer_target import check_target
from mavbridge.recording.folder import prepare_folder
from policy.loading.load import check_request


def signing_note(config: LinkConfig) -> str | None:
    """Return a note if other computers can steer the vehicle because packets are not signed, else
    None."""
    if config.signing_key_file is not None or not is_reachable(config.connect):
        return None
    return (
        f"packets on {config.connect} are not signed: anybody on this network can steer the "
        "vehicle; --signing-key-file signs them"
    )


def check_flight(config: FlyConfig) -> None:
    """Run the cheap checks first; loading weights takes seconds. The guard checks the link itself.

    Raises:
        MavbridgeError: a flag names something that cannot be opened, written or loaded.
    """
    parse_address(config.link.connect)
    for source in config.camera.sources:
        check_camera(source, latency_ms=config.camera.camera_latency)
    check_request(policy_request(config.policy))
    require_images(config)
    for _name, _value, check in file_checks(config):
        check()
    require_cameras(config)


def file_checks(config: FlyConfig) -> Iterator[tuple[str, object, Callable[[], object]]]:
    """Yield name, value and check of each file that a flight uses, and of its viewer.

    A check creates folders, as the flight does, and raises MavbridgeError.
    """
    if config.report is not None:
        yield "report", config.report, partial(require_writable, config.report, "--report")
    if config.gates is not None:
        yield "gates", config.gates, partial(read_gates, config.gates)
    if config.record is not None:
        yield "recording", config.record, partial(prepare_folder, config.record, "--record")
    if config.rerun != "off":
        yield "viewer", config.rerun, partial(check_target, config.rerun)


def output_folders(config: FlyConfig) -> tuple[Path | None, ...]:
    """Return the folders that a flight may create."""
    viewer_folder = Path(config.rerun).parent if config.rerun.endswith(".rrd") else None
    return config.record, config.report and config.report.parent, viewer_folder
