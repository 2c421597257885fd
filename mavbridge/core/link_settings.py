"""Settings of the link, without the command line that they come from."""

from dataclasses import dataclass
from pathlib import Path

from mavbridge.core.vehicle import Risk


@dataclass(frozen=True, slots=True, kw_only=True)
class SigningFiles:
    """Files of MAVLink 2 signing."""

    key_file: Path
    """Readable by its owner alone; the settings never hold the key itself."""
    state_folder: Path
    """Keeps the timestamps, which must never step back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSettings:
    """The vehicle and how to reach it."""

    connect: str = ""
    """Address of the vehicle, as ``core.address`` reads it."""
    source_system: int = 255
    """Our MAVLink system id."""
    target_system: int = 0
    """System id of the vehicle to fly; 0 = the only one on the link."""
    connect_timeout_s: float = 30.0
    """Longest wait for the vehicle's first heartbeat."""
    readonly: bool = False
    """Receive and set up streams; send no stick, mode or arm command."""
    state_hz: float = 100.0
    """Rate of attitude, velocity and acceleration to ask the vehicle for."""
    min_battery_percent: float = 0.0
    """Charge below which the battery is reported as low; 0 = only what the vehicle itself says."""
    pilot_hz: float | None = None
    """Rate of RC_CHANNELS to ask for where a pilot's flight is recorded, and none of our own sticks
    will leave; None: what the check of those needs."""
    stick_hz: float = 100.0
    """Rate at which sticks will be sent."""
    set_params: tuple[tuple[str, float], ...] = ()
    """Parameters to set for the flight, by name."""
    accepted_risks: tuple[Risk, ...] = ()
    known_params: frozenset[str] | None = None
    """Parameters to ask for, of those that matter: a replay asks as the flight did. None: all."""
    signing: SigningFiles | None = None
    """Sign what is sent, and take only what is signed."""
