"""Settings of the guard: of its process, and of a flight."""

from dataclasses import dataclass

from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.vehicle import ActionMeaning, Output
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.guard.envelope import EnvelopeLimits
from mavbridge.guard.limits import Smoothing
from mavbridge.guard.memory import EngagementSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardSettings:
    """The vehicle, and how the process runs; known before any policy is loaded."""

    link: LinkSettings
    realtime: bool = True
    """Real-time scheduling, where the system permits it."""
    cpu: int | None = None
    """Run on this CPU alone."""
    tlog_fd: int | None = None
    """Write end of the pipe of the telemetry log."""
    keeps_packets: bool = False
    """Pass the vehicle's packets on, for a recorder."""
    wall_offset_ns: int = 0
    """Wall time minus the clock, for the telemetry log."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSettings:
    """Settings of a flight, known once its policy is loaded."""

    meaning: ActionMeaning
    output: Output | None = None
    """Message that carries the actions; None = the usual one of their kind and the vehicle."""
    stick_period_ns: int
    chunk_period_ns: int
    """Between the policy's chunks."""
    freshness: FreshnessLimits
    smoothing: Smoothing
    envelope: EnvelopeLimits
    engagement: EngagementSettings
    watches_home_height: bool
    """The policy takes the height above home, which the vehicle is asked for then."""
    watches_position: bool
    """It takes a position: the flight process is told whether there is one to be trusted."""
