"""A way to the vehicle that is too narrow for the sticks, and drops what does not fit."""

import pytest

from helpers.output_flights import OutputFlight
from mavbridge.guard.values import Phase
from policy.contract import ActionKind
from sitl.vehicle.config import AutopilotName


@pytest.mark.parametrize("share", [0.2, 0.25, 0.35, 0.5])
@pytest.mark.parametrize(
    ("autopilot", "kind"),
    [("ardupilot", "sticks"), ("ardupilot", "velocity"), ("px4", "sticks"), ("px4", "rates")],
)
def test_sticks_that_wait_in_a_full_queue_end_the_flight(
    autopilot: AutopilotName, kind: ActionKind, share: float
) -> None:
    flight = OutputFlight(autopilot, kind).fly()
    sent = [data for _, data in flight.up.sent]
    at_ns = flight.clock.now_ns()
    flight.run(1.0)
    needed = sum(len(data) for _, data in flight.up.sent[len(sent) :])
    flight.up.bytes_per_s = share * needed * 1e9 / (flight.clock.now_ns() - at_ns)
    flight.until(lambda: flight.phase is not Phase.FLYING, within_s=4.0)
