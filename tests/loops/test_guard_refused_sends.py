"""The system takes none of our packets (no route, EPERM, full queue), while the vehicle's come."""

import pytest

from helpers.guard_flights import GuardFlight
from helpers.output_flights import OutputFlight
from mavbridge.guard.values import Phase
from mavbridge.mavlink.transport.connection import REFUSED_NS
from policy.contract import ActionKind
from sitl.vehicle.config import AutopilotName

SLOT_S = 0.01
KINDS: tuple[tuple[AutopilotName, ActionKind], ...] = (
    ("ardupilot", "sticks"),
    ("ardupilot", "velocity"),
    ("px4", "sticks"),
    ("px4", "rates"),
)


def refuse(flight: GuardFlight, *, is_refused: bool = True) -> None:
    network = flight.network
    if is_refused:
        network.send = lambda data, peer=None: False  # type: ignore[method-assign]
    else:
        del network.send  # type: ignore[attr-defined]


@pytest.mark.parametrize(("autopilot", "kind"), KINDS)
def test_in_flight_they_are_a_fault_of_the_link_after_100_ms(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    flight = OutputFlight(autopilot, kind).fly()
    refuse(flight)
    took_s = flight.until(lambda: flight.phase is not Phase.FLYING, within_s=0.5)
    assert took_s <= REFUSED_NS / 1e9 + 2 * SLOT_S
    assert flight.phase is Phase.LEAVING
    assert flight.guard.outcome.faults == 1


def test_before_an_act_they_refuse_it() -> None:
    flight = GuardFlight().launch()
    refuse(flight)
    flight.run(1.5)
    flight.act("engage")
    flight.run(5)
    assert Phase.FLYING not in flight.phases()
    refuse(flight, is_refused=False)
    flight.run(1.5)
    flight.act("engage")
    flight.run(0.2)
    assert flight.phase is Phase.FLYING


@pytest.mark.parametrize("gap_s", [0.03, 0.06, 0.07])
@pytest.mark.parametrize("flown_s", [0.0, 1.0], ids=["from the act on", "in flight"])
def test_the_sticks_go_on_from_where_the_vehicles_are(gap_s: float, flown_s: float) -> None:
    """From the receiver's, or from our last ones, and no faster than ever."""
    wanted = [(0.0, 0.1, 0.2, 0.3)]
    flight = GuardFlight(lambda _: wanted[0]).launch()
    if not flown_s:
        refuse(flight)
    flight.act("engage")
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=0.1)
    flight.run(flown_s)
    refuse(flight)
    wanted[0] = (0.0, -0.8, -0.8, -0.8)
    before = [tick.sent for tick in flight.ticks if tick.sent is not None]
    flight.run(gap_s)
    refuse(flight, is_refused=False)
    resumed_ns = flight.clock.now_ns()
    flight.run(0.03)
    assert flight.phase is Phase.FLYING
    first = flight.sticks_sent(resumed_ns)[0][1]
    held = before[-1] if before else (0.0, 0.0, 0.0, 0.0)
    assert first == pytest.approx(held, abs=0.03)
    flight.run(0.5)
    assert flight.last is not None
    assert flight.last.sent is not None
    assert flight.last.sent.roll == pytest.approx(-0.8, abs=0.02)
