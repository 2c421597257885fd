"""A square in every kind of action on both firmwares: from arming to the end, on the vehicle."""

import math
from itertools import pairwise

import pytest

from helpers.output_flights import COMBINATIONS, LEG_M, SQUARE, SQUARE_S, OutputFlight
from mavbridge.guard.values import Phase
from policy.contract import ActionKind
from policy.motion.controllers import LEG_S
from sitl.vehicle.config import AutopilotName

TAKEOFF_M = 3.0
LEGS = ((1, 0), (0, 1), (-1, 0), (0, -1))
"""Forward, right, back, left; the heading of the start is north."""
ENDS = {
    ("ardupilot", "sticks"): ("ALT_HOLD", True),
    ("ardupilot", "attitude"): ("BRAKE", True),
    ("ardupilot", "rates"): ("BRAKE", True),
    ("ardupilot", "velocity"): ("BRAKE", True),
    ("px4", "sticks"): ("AUTO.LAND", False),
    ("px4", "attitude"): ("AUTO.LAND", False),
    ("px4", "rates"): ("AUTO.LAND", False),
    ("px4", "velocity"): ("AUTO.LAND", False),
}
"""Mode after a normal end with the defaults, and whether the vehicle is still armed then: a
receiver has the sticks, or the mode holds; without one it lands."""


def along_and_across(
    leg: tuple[int, int], before: tuple[float, float], after: tuple[float, float]
) -> tuple[float, float]:
    """How far it went along a leg, and to its side, in metres."""
    north, east = after[0] - before[0], after[1] - before[1]
    return leg[0] * north + leg[1] * east, abs(leg[1] * north - leg[0] * east)


def fly_square(flight: OutputFlight) -> list[tuple[float, float]]:
    """The corners, the start among them, in metres north and east."""
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=25)
    flight.run(0.05)  # the policy is reset when a flight begins
    flight.until(lambda: flight.scripted.program_start_s is not None, within_s=15)
    start_s = flight.scripted.program_start_s or 0.0
    flight.until(lambda: flight.now_s >= start_s, within_s=3)
    corners = [flight.position_ned_m[:2]]
    for _ in LEGS:
        flight.run(LEG_S)
        corners.append(flight.position_ned_m[:2])
    assert flight.phase is Phase.FLYING, flight.describe()
    return corners


@pytest.mark.parametrize(("autopilot", "kind"), COMBINATIONS)
def test_a_square_is_flown_from_arming_to_the_end(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    cannot_lift_off = (autopilot, kind) == ("ardupilot", "velocity")
    takeoff_m = TAKEOFF_M if cannot_lift_off else None
    flight = OutputFlight(
        autopilot, kind, SQUARE, in_air=cannot_lift_off, arm=True, takeoff=takeoff_m
    )
    corners = fly_square(flight)
    for leg, (before, after) in zip(LEGS, pairwise(corners), strict=True):
        along, across = along_and_across(leg, before, after)
        assert 0.5 * LEG_M < along < 1.1 * LEG_M, (leg, corners)
        assert across < 0.4 * LEG_M, (leg, corners)
    assert math.dist(corners[0], corners[-1]) < 0.4 * LEG_M, corners
    heights = [-s.position_ned_m[2] for s in flight.samples if s.t_s > flight.t_s - SQUARE_S]
    assert min(heights) > 2.2
    assert max(heights) < 3.8
    assert max(s.lean_deg for s in flight.samples) < 25

    flight.stop()
    mode, is_armed = ENDS[autopilot, kind]
    flight.until(
        lambda: flight.phase is Phase.ENDED and flight.samples[-1].armed == is_armed, within_s=25
    )
    assert flight.samples[-1].armed == is_armed, flight.describe()
    assert mode in {s.mode for s in flight.samples}, flight.describe()
    assert not any(s.failsafe for s in flight.samples)
    assert not flight.summary["refused_messages"]
    assert not flight.summary["crashed"]
    if is_armed:
        assert heights[-1] - flight.height_m == pytest.approx(0, abs=0.6)
        assert flight.samples[-1].lean_deg < 15, "braking at most"
