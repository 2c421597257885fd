"""Ten seconds after every ending, with every receiver: no ArduPilot in the air is left to fall."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest

from helpers.guard_flights import NAN, GuardFlight, climbing_first, leaning
from mavbridge.core.reasons import Code, because
from mavbridge.guard.values import Phase
from sitl.vehicle.config import IDLE_RECEIVER_US

AFTER_S = 10.0
MOST_IMPACT_MPS = 1.0
"""It touches down at 0.5 m/s (LAND_SPEED)."""
MOST_LOST_M = 2.0
"""BRAKE stops within 1.8 m from 2.5 m/s of descent under an idle throttle, the worst that a silence
can leave."""
MOST_SINK_MPS = 1.6
"""A landing from a height: 1.5 m/s (WPNAV_SPEED_DN)."""
LANDINGS = ("LAND", "RTL")


class Ending(NamedTuple):
    """A way in which a flight ends by our own doing."""

    act: Callable[[GuardFlight], object]
    settings: dict[str, Any] = {}  # noqa: RUF012


def cut(seconds: float) -> Callable[[GuardFlight], None]:
    """Nothing passes either way for a while."""

    def act(flight: GuardFlight) -> None:
        flight.up.is_silent = flight.down.is_silent = True
        flight.run(seconds)
        flight.up.is_silent = flight.down.is_silent = False

    return act


def deaf(flight: GuardFlight) -> None:
    """Nothing of ours arrives for a while; the vehicle is heard."""
    flight.up.is_silent = True
    flight.run(4.0)
    flight.up.is_silent = False


def hang(flight: GuardFlight) -> None:
    flight.is_flight_process_stopped = True
    flight.run(0.5)
    flight.is_flight_process_stopped = False


def fault(flight: GuardFlight) -> None:
    flight.stop(because(Code.CAMERA_FAILED, camera=""), is_fault=True)


def not_a_number(flight: GuardFlight) -> None:
    flight.policy = lambda _: NAN


ENDINGS = {
    "death": Ending(GuardFlight.die),
    "hang": Ending(hang),
    "NaN": Ending(not_a_number),
    "end": Ending(GuardFlight.stop),
    "end, release": Ending(GuardFlight.stop, {"then": "release"}),
    "key": Ending(lambda flight: flight.act("release")),
    "fault, release": Ending(fault, {"on_fault": "release"}),
    "cut 1.5 s": Ending(cut(1.5)),
    "cut 3.5 s": Ending(cut(3.5)),
    "deaf 4 s": Ending(deaf),
    "standstill 1.5 s": Ending(lambda flight: flight.stand_still(1.5)),
    "standstill 4 s": Ending(lambda flight: flight.stand_still(4.0)),
}
CASES = [(name, "idle") for name in ENDINGS] + [
    (name, receiver)
    for name in ("death", "end", "end, release", "cut 3.5 s")
    for receiver in ("middle", "absent")
]
"""Every ending over the worst receiver, some over the others; the catalogue of faults has the rest,
and PX4, in real time."""
OUTAGES = {name for name in ENDINGS if name.endswith(" s")}


def in_the_air(receiver: str, settings: dict[str, Any]) -> GuardFlight:
    """The policy flies ArduPilot in ALT_HOLD, over a receiver whose throttle rests so."""
    if receiver == "absent":
        flight = GuardFlight(climbing_first, receiver_us=None, arm=True, **settings)
        return flight.take_off(5.0)
    flight = GuardFlight(leaning, **settings).launch()
    if receiver == "idle":
        flight.receiver(ch3=IDLE_RECEIVER_US[2])
        flight.run(0.2)
    flight.act("engage")
    flight.run(1.2)
    assert flight.phase is Phase.FLYING, flight.describe()
    return flight


def judge(flight: GuardFlight, ending: Ending) -> list[str]:
    """Bring the flight to its end, and judge the ten seconds after it; returns the later modes."""
    before = len(flight.modes)
    ending.act(flight)
    start_m = lowest_m = flight.height_m
    sink_mps = 0.0
    for _ in range(round(AFTER_S / 0.05)):
        flight.run(0.05)
        lowest_m = min(lowest_m, flight.height_m)
        if start_m - lowest_m > MOST_LOST_M:
            sink_mps = max(sink_mps, flight.ap.truth.velocity_ned_mps[2])
    modes = flight.modes[before:]
    impact_mps = flight.vehicle.log.summary(flight.vehicle.ap)["impact_speed_mps"]
    assert impact_mps <= MOST_IMPACT_MPS, (modes, flight.describe())
    if not modes or modes[-1] not in LANDINGS:
        assert start_m - lowest_m <= MOST_LOST_M, (modes, flight.describe())
    assert sink_mps <= MOST_SINK_MPS, (modes, flight.describe())
    assert flight.phase is not Phase.FLYING
    return modes


@pytest.mark.parametrize(("name", "receiver"), CASES)
def test_after_an_ending_ardupilot_holds_or_lands(name: str, receiver: str) -> None:
    ending = ENDINGS[name]
    modes = judge(in_the_air(receiver, ending.settings), ending)
    is_end = name in ("end", "end, release", "key")
    if name in OUTAGES and receiver == "absent":
        assert modes == ["RTL"], "its own failsafe is its way out, and stays"
    elif receiver == "middle" and name not in OUTAGES:
        assert modes == [], "the hand holds it in the mode of the flight"
    elif receiver != "middle":
        assert modes == (["LAND"] if is_end else ["BRAKE"])
