"""Reports of invented flights."""

from mavbridge.core.records import Tick
from mavbridge.core.vehicle import LinkStats
from mavbridge.observe.timing import FlightTiming, ObserverDrops, TimingReport


def report_of(
    *ticks: Tick, link: LinkStats | None = None, rerun_drops: int | None = None
) -> TimingReport:
    """Return the report of a flight with these ticks, at 100 and 30 Hz."""
    timing = FlightTiming(stick_hz=100, action_hz=100, vision_hz=30)
    for tick in ticks:
        timing.emit(tick)
    return timing.report(
        mode="dual",
        engine="torch",
        policy="toge-small",
        autopilot="ardupilot",
        link=link,
        observer_drops=ObserverDrops(rerun=rerun_drops, recorder=None),
    )
