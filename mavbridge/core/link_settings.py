"""Settings of the link, independent of the command line."""

from dataclasses import dataclass
from pathlib import Path

from mavbridge.core.vehicle import Risk


@dataclass(frozen=True, slots=True, kw_only=True)
class SigningFiles:
    """Files of MAVLink 2 signing."""

    key_file: Path
    """Key file, readable by its owner only. The settings never hold the key itself."""
    state_folder: Path
    """Folder of the signing timestamps, which must never decrease."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """Vehicle to fly, and how to reach it."""

    connect: str = ""
    """Address of the vehicle, as ``core.address`` parses it."""
    source_system: int = 255
    """Our MAVLink system id."""
    target_system: int = 0
    """System id of the vehicle to fly; 0: the only one on the link."""
    connect_timeout_s: float = 30.0
    """Longest wait for the vehicle's first heartbeat."""
    readonly: bool = False
    """Receive and request streams; send no stick, mode or arm command."""
    state_hz: float = 100.0
    """Requested rate of attitude, velocity and acceleration."""
    min_battery_percent: float = 0.0
    """Charge below which the battery is reported as low; 0: rely on the vehicle's own report."""
    pilot_hz: float | None = None
    """Requested rate of RC_CHANNELS while a pilot's flight is recorded and no stick of ours is
    sent; None: the rate that the echo check needs."""
    stick_hz: float = 100.0
    """Rate at which sticks will be sent."""
    set_params: tuple[tuple[str, float], ...] = ()
    """Parameters to set for the flight."""
    accepted_risks: tuple[Risk, ...] = ()
    known_params: frozenset[str] | None = None
    """Parameters to request; None: all that matter for a flight. A replay requests those of its
    flight."""
    signing: SigningFiles | None = None
    """Sign sent packets, and accept signed packets only."""
