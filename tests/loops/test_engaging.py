"""How a flight on virtual time begins, loses its inputs, and ends."""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from helpers.fakes import START_NS
from helpers.guard_facts import figures
from helpers.virtual_flights import FRAME_NS, MS, STEADY, VirtualFlight, nan_chunk
from mavbridge.config.flight import Limits
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, Value, because
from mavbridge.core.vehicle import IDLE, NEUTRAL, Command, Decision, Release, Sticks
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


def test_a_policy_that_returns_nan_every_other_time_loses_the_sticks_once() -> None:
    flight = VirtualFlight(chunk=lambda k: nan_chunk() if k > 50 and k % 2 else STEADY).fly(3.0)
    assert Code.UNUSABLE_CHUNKS in given_back(flight).codes


def test_a_policy_that_always_returns_nan_never_moves_a_stick() -> None:
    flight = VirtualFlight(chunk=lambda solve: nan_chunk()).fly(0.5)
    assert flight.link.decisions == []
    assert Code.NOT_FINITE in flight.codes


@pytest.mark.parametrize("shape", [(16, 4), (2, 16, 4), (1, 0, 4), (1, 16, 3), (1, 1025, 4)])
def test_a_chunk_of_another_shape_never_moves_a_stick(shape: tuple[int, ...]) -> None:
    flight = VirtualFlight(chunk=lambda solve: np.zeros(shape, np.float32)).fly(0.5)
    assert flight.link.decisions == []
    assert figures(flight.reason, Code.WRONG_SHAPE)["shape"] == str(list(shape))


# --- how a flight begins and ends


def test_the_policy_takes_over_from_where_the_sticks_are() -> None:
    pilot = Sticks(0.1, 0.0, -0.3, 0.0)
    flight = VirtualFlight(limits=Limits(tau=0.0, max_slew=1.0), status={"pilot_sticks": pilot})
    flight.fly(0.1)
    assert flight.sent[0][1] == pilot
    steps = [np.abs(np.subtract(b, a)).max() for (_, a), (_, b) in pairwise(flight.sent)]
    assert max(steps) <= 0.0101


def test_arming_goes_through_idle_and_asks_for_the_mode_first() -> None:
    status = {"armed": False, "mode": "STABILIZE", "is_landed": True}
    flight = VirtualFlight(status=status, duration=0.5).fly(3.0)
    assert flight.link.requests == ["mode ALT_HOLD", "arm"]
    kinds = flight.link.hands
    assert kinds[:2] == [Command(action=IDLE), QUARTER]


def test_a_vehicle_that_does_not_obey_is_asked_once_a_second() -> None:
    flight = VirtualFlight(status={"armed": False, "is_landed": True})
    flight.link.obeys = False
    flight.fly(4.5)
    assert flight.link.requests == ["arm"] * 5
    assert set(sticks_of(flight.link.hands)) == {IDLE}


@pytest.mark.parametrize(
    ("status", "end", "requests", "phase"),
    [
        ({}, Release(because(Code.DURATION)), [], Phase.ENDED),
        ({"has_receiver": False}, Command(action=NEUTRAL), ["mode LAND"], Phase.HOLDING),
    ],
    ids=["receiver", "no receiver"],
)
def test_a_flight_ends_after_its_duration(
    status: dict[str, Any], end: Decision, requests: list[str], phase: Phase
) -> None:
    flight = VirtualFlight(status=status, duration=0.5).fly(3.0)
    assert flight.link.hands[0] == QUARTER
    assert flight.link.hands[1] == Command(action=NEUTRAL)
    assert flight.link.hands[-1] == end
    assert flight.link.requests == requests
    assert flight.phase is phase
    flown_ns = flight.flown[-1].sent_ns - flight.flown[0].sent_ns
    assert flown_ns == pytest.approx(NS_PER_S // 2, abs=PERIOD_NS)


def test_duration_counts_from_the_first_moment_of_flight() -> None:
    flight = VirtualFlight(status={"armed": False, "is_landed": True}, duration=0.5)
    flight.link.obeys = False
    flight.at(2.0, lambda: flight.link.change(armed=True)).fly(4.0)
    flown_ns = flight.flown[-1].sent_ns - flight.flown[0].sent_ns
    assert flown_ns == pytest.approx(NS_PER_S // 2, abs=PERIOD_NS)
    assert flight.flown[0].sent_ns >= START_NS + 2 * NS_PER_S


def test_neutral_goes_on_without_a_receiver_until_the_vehicle_is_disarmed() -> None:
    flight = VirtualFlight(status={"has_receiver": False}, duration=0.2)
    flight.at(30.0, lambda: flight.link.change(armed=False)).fly(31.0)
    neutral_s = [at_s for at_s, sticks in flight.sent if sticks == NEUTRAL]
    assert max(np.diff(neutral_s)) <= 0.015
    assert neutral_s[-1] == pytest.approx(30.0, abs=0.011)
    assert flight.guard.is_done


def test_sticks_that_are_the_pilots_are_not_touched_on_the_way_out() -> None:
    flight = VirtualFlight(arm=False)
    flight.at(0.5, flight.stop).fly(1.0)
    assert flight.guard.is_done
    assert flight.link.decisions == []


def test_a_takeover_releases_in_the_same_moment_and_sends_no_mode() -> None:
    flight = VirtualFlight()
    flight.at(0.5005, lambda: flight.link.change(mode="LOITER")).fly(2.0)
    changed = because(Code.MODE_CHANGED, before="ALT_HOLD", after="LOITER")
    assert flight.link.hands == [QUARTER, Release(changed)]
    assert flight.sent[-1][0] == pytest.approx(0.503, abs=0.0001)  # the vehicle's next packet
    assert flight.link.requests == []
    flight.link.change(mode="ALT_HOLD")
    flight.fly(2.0)
    assert len(flight.link.hands) == 2
    assert Code.MODE_CHANGED in flight.codes
