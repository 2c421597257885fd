"""How a flight on virtual time begins, loses its inputs, and ends."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest

from helpers.fakes import START_NS
from helpers.guard_facts import figures
from helpers.virtual_flights import FRAME_NS, MS, STEADY, VirtualFlight, nan_chunk
from mavbridge.config.flight import Limits
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, Value
from mavbridge.core.vehicle import NEUTRAL, Command, Decision, Release, Sticks
from mavbridge.guard.values import Phase

PERIOD_NS = 10 * MS
QUARTER = Command(action=Sticks(0.25, 0.25, 0.25, 0.25))


def sticks_of(decisions: list[Decision]) -> list[Sticks | None]:
    return [one.action if isinstance(one, Command) else None for one in decisions]


def given_back(flight: VirtualFlight) -> Reason:
    """Why, as the guard and the link were told, after a way out with neutral sticks."""
    assert flight.reason is not None
    assert flight.link.hands == [QUARTER, Command(action=NEUTRAL), Release(flight.reason)]
    return flight.reason


# --- losing the inputs


def test_a_camera_that_stops_ends_the_flight_and_one_that_returns_does_not_fly_again() -> None:
    times = [START_NS + k * FRAME_NS for k in range(150)]
    gap = [t for t in times if not NS_PER_S < t - START_NS < 2 * NS_PER_S]
    flight = VirtualFlight(frames_ns=gap).fly(3.0)
    found = figures(given_back(flight), Code.LATE)
    assert (found["limit_ms"], found["place"]) == (300, "camera")
    assert flight.phase is Phase.RELEASED
    last = flight.flown[-1]
    assert last.is_coasting
    assert last.feature_captured_ns is not None
    assert 300 * MS < last.sent_ns - last.feature_captured_ns <= 415 * MS
    neutral_s = [at_s for at_s, sticks in flight.sent if sticks == NEUTRAL]
    assert neutral_s[-1] - neutral_s[0] == pytest.approx(0.05, abs=0.011)
    assert flight.link.requests == []  # with a receiver whose throttle is in the middle
    flight.tell("engage")
    flight.fly(0.5)
    assert flight.phase is Phase.FLYING
    assert flight.resets == 2


def stale_attitude(flight: VirtualFlight) -> None:
    """It keeps arriving, and tells about the same moment from then on for 100 ms."""
    flight.measure = lambda: flight.link.measure(age_ns=101 * MS)


def no_attitude(flight: VirtualFlight) -> None:
    flight.measure = lambda: None


def no_velocity(flight: VirtualFlight) -> None:
    flight.link.lacks = "velocity_ned_mps"


@pytest.mark.parametrize(
    ("lose", "seconds", "code", "known"),
    [
        (stale_attitude, 0.2, Code.TOO_OLD, {"quantity": "attitude", "limit_ms": 100}),
        (no_attitude, 0.1, Code.LATE, {"quantity": "attitude", "place": "link"}),
        (no_velocity, 0.35, Code.TOO_OLD, {"quantity": "velocity", "limit_ms": 250}),
    ],
)
def test_a_state_that_is_lost_ends_the_flight_after_the_grace(
    lose: Callable[[VirtualFlight], None], seconds: float, code: Code, known: dict[str, Value]
) -> None:
    flight = VirtualFlight()
    flight.at(1.0, lambda: lose(flight)).fly(3.0)
    found = figures(given_back(flight), code)
    assert found | known == found
    assert flight.sent[-1][0] < 1.0 + seconds + 0.1
    flown_until_s = (flight.flown[-1].sent_ns - START_NS) / NS_PER_S
    assert flown_until_s == pytest.approx(1.0 + seconds, abs=0.02)


def test_inputs_that_never_come_never_move_a_stick() -> None:
    flight = VirtualFlight()
    flight.link.lacks = "velocity_ned_mps"
    flight.fly(1.0)
    assert flight.link.decisions == []
    assert flight.codes == (Code.NO_READING,)


def test_inputs_that_flicker_do_not_toss_the_sticks_to_and_fro() -> None:
    flight = VirtualFlight()
    count = iter(range(1000))
    flight.measure = lambda: flight.link.measure() if next(count) % 20 < 14 else None
    flight.fly(5.0)
    assert flight.link.hands == [QUARTER]


def test_one_chunk_with_nan_is_not_flown_and_costs_no_stick() -> None:
    flight = VirtualFlight(chunk=lambda solve: nan_chunk() if solve == 50 else STEADY).fly(2.0)
    assert flight.link.hands == [QUARTER]
    assert 51 not in {tick.chunk_serial for tick in flight.flown}
    assert np.diff([tick.sent_ns for tick in flight.flown]).max() <= 1.5 * PERIOD_NS


def test_a_policy_that_always_returns_nan_never_moves_a_stick() -> None:
    flight = VirtualFlight(chunk=lambda solve: nan_chunk()).fly(0.5)
    assert flight.link.decisions == []
    assert Code.NOT_FINITE in flight.codes


# --- how a flight begins and ends


def test_the_policy_takes_over_from_where_the_sticks_are() -> None:
    pilot = Sticks(0.1, 0.0, -0.3, 0.0)
    flight = VirtualFlight(limits=Limits(tau=0.0, max_slew=1.0), status={"pilot_sticks": pilot})
    flight.fly(0.1)
    assert flight.sent[0][1] == pilot
    steps = [np.abs(np.subtract(b, a)).max() for (_, a), (_, b) in pairwise(flight.sent)]
    assert max(steps) <= 0.0101
