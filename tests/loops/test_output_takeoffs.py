"""The way in: takeoff by the autopilot's own means, and what may happen meanwhile."""

import pytest

from helpers.output_flights import HOVERING, OutputFlight
from mavbridge.guard.values import Phase
from policy.contract import ActionKind
from sitl.vehicle.config import AutopilotName

SETPOINTS = {"SET_ATTITUDE_TARGET", "SET_POSITION_TARGET_LOCAL_NED"}
TAKEOFFS: list[tuple[AutopilotName, ActionKind]] = [
    ("ardupilot", "velocity"),
    ("ardupilot", "sticks"),
    ("px4", "velocity"),
    ("px4", "sticks"),
]
HEIGHT_M = 3.0


def taking_off(autopilot: AutopilotName, kind: ActionKind) -> OutputFlight:
    """A meter above the ground, on the autopilot's own way up."""
    flight = OutputFlight(autopilot, kind, HOVERING, arm=True, takeoff=HEIGHT_M)
    flight.until(lambda: flight.height_m > 1.0, within_s=30)
    assert flight.phase is Phase.PREPARING, flight.describe()
    return flight


def setpoints(flight: OutputFlight, since_ns: int) -> int:
    """Number of setpoints that left."""
    return sum(m.get_type() in SETPOINTS for _, m in flight.left(since_ns))


@pytest.mark.parametrize(("autopilot", "kind"), TAKEOFFS)
def test_the_policy_flies_at_the_height_of_the_takeoff(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    flight = taking_off(autopilot, kind)
    assert not setpoints(flight, 0) or flight.is_px4, "they would end ArduPilot's takeoff"
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=10)
    assert flight.samples[-1].mode == flight.mode
    flight.run(3)
    assert flight.phase is Phase.FLYING, flight.describe()
    assert flight.height_m == pytest.approx(HEIGHT_M, abs=0.8)
    assert not any(s.failsafe for s in flight.samples)


@pytest.mark.parametrize(("autopilot", "kind"), TAKEOFFS[1:3])
def test_a_takeoff_is_ended_by_the_death_of_the_flight_process(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    flight = taking_off(autopilot, kind)
    flight.die()
    flight.run(3)
    hold = "AUTO.LOITER" if flight.is_px4 else "BRAKE"
    assert flight.samples[-1].mode == hold, flight.describe()
    assert flight.height_m < HEIGHT_M + 0.5
    assert not any(s.failsafe for s in flight.samples)
