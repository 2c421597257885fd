"""Settings of the guard process, and of a flight."""

from dataclasses import dataclass

from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.vehicle import ActionMeaning, Output
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.guard.envelope import EnvelopeLimits
from mavbridge.guard.limits import Smoothing
from mavbridge.guard.values import EngagementSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardSettings:
    """Settings of the link and of the process, known before a policy is loaded."""

    link: LinkSettings
    realtime: bool = True
    """Use real-time scheduling if the system permits it."""
    tlog_fd: int | None = None
    """Write end of the telemetry log's pipe."""
    keeps_packets: bool = False
    """Forward the vehicle's packets to a recorder."""
    wall_offset_ns: int = 0
    """Wall time minus the monotonic clock, for the telemetry log."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSettings:
    """Settings of a flight, known once its policy is loaded."""

    meaning: ActionMeaning
    output: Output | None = None
    """Message that carries the actions; None: the default of their kind and the vehicle."""
    stick_period_ns: int
    chunk_period_ns: int
    """Time between the policy's chunks."""
    freshness: FreshnessLimits
    smoothing: Smoothing
    envelope: EnvelopeLimits
    engagement: EngagementSettings
    watches_home_height: bool
    """True if the policy takes the height above home: it is requested from the vehicle."""
    watches_position: bool
    """True if the policy takes a position: the flight process is told while a valid one exists."""
