"""Settings of the guard process, known before any policy is loaded."""

from dataclasses import dataclass

from mavbridge.mavlink.settings import LinkSettings


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardSettings:
    """The vehicle, and how the process runs."""

    link: LinkSettings
    realtime: bool = True
    """Real-time scheduling, where the system permits it."""
    cpu: int | None = None
    """Run on this CPU alone."""
    tlog_fd: int | None = None
    """Write end of the pipe of the telemetry log."""
    wall_offset_ns: int = 0
    """Wall time minus the clock, for the telemetry log."""
