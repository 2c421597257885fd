"""Settings of ``mavbridge identify``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mavbridge.config.flight import FlyConfig
from mavbridge.config.groups import OUTPUT


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class IdentifyConfig:
    """One flight of the doublet; policy and checkpoint are what it is compared with."""

    flight: FlyConfig = field(default_factory=FlyConfig)
    mapped_sticks: Annotated[bool, Parameter(negative="", group=OUTPUT)] = False
    """Send the sticks through the inverse of the vehicle's curves, as a flight does; by default the
    vehicle's own gains are measured."""
    json: Annotated[Path | None, Parameter(group=OUTPUT)] = None
    """Write all figures here as JSON."""
