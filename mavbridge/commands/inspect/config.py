"""Settings of ``mavbridge inspect``."""

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from mavbridge.config.groups import OUTPUT


@Parameter(name="*", group=OUTPUT)
@dataclass(frozen=True, kw_only=True)
class InspectConfig:
    """What is made of recorded flights, besides the tables on the terminal."""

    html: Path | None = None
    """Write one page with the plots, the path, the worst moments and the video in it."""
    json: Path | None = None
    """Write the figures as JSON: a list with an object for each flight."""
    rerun: str = "off"
    """Show the flight in the Rerun viewer: spawn, connect[=URL], FILE.rrd, or off."""
    gates: Path | None = None
    """Draw the gates of this file, that of python -m sitl course --json; a recording by the
    simulator knows its own."""
