"""Settings of ``mavbridge check``."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from mavbridge.config.checks import check_range
from mavbridge.config.flight import FlyConfig
from mavbridge.config.groups import OUTPUT, RATES, VEHICLE


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class CheckConfig:
    """The flight to check, by its own flags."""

    flight: FlyConfig = field(default_factory=FlyConfig)
    echo_test: Annotated[bool, Parameter(negative="", group=VEHICLE)] = False
    """Send neutral sticks for up to three seconds, only while disarmed, and see whether the vehicle
    takes them from our system id; then release them."""
    timing: Annotated[float, Parameter(group=RATES)] = 3.0
    """Seconds for which the policy is run at its rates, on one dummy sample; minutes show whether
    this computer throttles."""
    json: Annotated[Path | None, Parameter(group=OUTPUT, allow_leading_hyphen=True)] = None
    """Write the rows here as JSON; - is standard output, and the table then goes to standard
    error."""

    def __post_init__(self) -> None:
        """Refuse durations that show nothing."""
        check_range("timing", self.timing, 0.5, 36_000, "s")
