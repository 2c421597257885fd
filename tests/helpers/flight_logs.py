"""The sticks in a telemetry log."""

from collections.abc import Iterator
from pathlib import Path

from pymavlink import mavutil

from faults.relay import Override


def logged_overrides(path: Path) -> Iterator[Override]:
    """Return the first four channels of every RC_CHANNELS_OVERRIDE."""
    log = mavutil.mavlogfile(str(path))
    while (message := log.recv_match(type="RC_CHANNELS_OVERRIDE")) is not None:
        yield Override(*(getattr(message, f"chan{k}_raw") for k in range(1, 5)))
    log.f.close()
