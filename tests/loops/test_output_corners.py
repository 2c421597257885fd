"""A corner in every kind of action on both firmwares: from arming to the end, on the vehicle."""

from itertools import pairwise

import pytest

from helpers.output_flights import COMBINATIONS, OutputFlight
from mavbridge.guard.values import Phase
from policy.contract import ActionKind
from policy.motion.controllers import Motion, Program
from sitl.vehicle.config import AutopilotName

LEG_S, LEG_MPS = 3.0, 1.5
LEG_M = LEG_S * LEG_MPS
FORWARD, LEFT = Motion(forward_mps=LEG_MPS), Motion(right_mps=-LEG_MPS)
"""The heading of the start is north."""
CORNER = Program(motion=lambda time_s: FORWARD if time_s < LEG_S else LEFT)


@pytest.mark.parametrize(("autopilot", "kind"), COMBINATIONS)
def test_a_corner_is_flown_from_arming_to_the_end(
    autopilot: AutopilotName, kind: ActionKind
) -> None:
    cannot_lift_off = (autopilot, kind) == ("ardupilot", "velocity")
    takeoff_m = 3.0 if cannot_lift_off else None
    flight = OutputFlight(
        autopilot, kind, CORNER, in_air=cannot_lift_off, arm=True, takeoff=takeoff_m
    )
    flight.until(lambda: flight.phase is Phase.FLYING, within_s=25)
    flight.run(0.05)  # the policy is reset when a flight begins
    flight.until(lambda: flight.scripted.program_start_s is not None, within_s=15)
    start_s = flight.scripted.program_start_s or 0.0
    flight.until(lambda: flight.now_s >= start_s, within_s=3)
    corners = [flight.position_ned_m[:2]]
    for _ in range(2):
        flight.run(LEG_S)
        corners.append(flight.position_ned_m[:2])
    assert flight.phase is Phase.FLYING, flight.describe()
    (ahead_m, right_m), (on_m, left_m) = ((b[0] - a[0], b[1] - a[1]) for a, b in pairwise(corners))
    assert 0.5 * LEG_M < ahead_m < LEG_M, corners
    assert -LEG_M < left_m < -0.5 * LEG_M, corners
    assert abs(right_m) < 0.4, corners
    assert 0 < on_m < 0.4 * LEG_M, "braking"
    heights = [-s.position_ned_m[2] for s in flight.samples if s.t_s > flight.t_s - 2 * LEG_S]
    assert min(heights) > 2.2
    assert max(heights) < 3.8
    assert max(s.lean_deg for s in flight.samples) < 25

    flight.stop()
    if flight.is_px4:  # without a receiver it lands
        flight.until(lambda: not flight.samples[-1].armed, within_s=25)
        flight.until(lambda: flight.phase is Phase.ENDED, within_s=2)
    else:  # a receiver has the sticks, or the mode holds
        flight.run(2.0)
        assert flight.samples[-1].armed
        assert heights[-1] - flight.height_m == pytest.approx(0, abs=0.6)
        assert flight.samples[-1].lean_deg < 15, "braking at most"
    mode = "AUTO.LAND" if flight.is_px4 else "ALT_HOLD" if kind == "sticks" else "BRAKE"
    assert mode in {s.mode for s in flight.samples}, flight.describe()
    assert flight.phase is Phase.ENDED
    assert not any(s.failsafe for s in flight.samples)
    assert not flight.summary["refused_messages"]
    assert not flight.summary["crashed"]
