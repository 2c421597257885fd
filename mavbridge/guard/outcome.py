"""How the flights of one guard went, for the exit status and the report."""

from typing import NamedTuple

from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import FlightEnd


class Outcome(NamedTuple):
    """How the policy's flights went, from one act to its end each, as far as they have come."""

    flights: int = 0
    """Times that the policy took the sticks."""
    has_left_ground: bool | None = None
    """In any of them; None: the vehicle does not tell."""
    faults: int = 0
    """Those that ended by a fault of ours."""
    is_disarmed: bool = False
    """The last one ended because the vehicle was disarmed, by itself or by somebody."""
    end: FlightEnd | None = None
    """How the last one ended; None before that."""
    fault: Reason | None = None
    """The last of those faults."""
