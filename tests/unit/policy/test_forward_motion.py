import math
from typing import Any

import pytest

from policy.contract import Contract
from policy.motion.forward_motion import ForwardMotion, Four, VehicleMotion
from policy.motion.stick_loop import GRAVITY_MPS2

HOVER = VehicleMotion((1.0, 0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3, (0.0, 0.0, -GRAVITY_MPS2))
HEADING_EAST = (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))
REST: dict[Any, Four] = {
    "sticks": (0.0, 0.0, 0.0, 0.0),
    "rates": (0.39, 0.0, 0.0, 0.0),
    "attitude": (0.39, 0.0, 0.0, 0.0),
    "velocity": (0.0, 0.0, 0.0, 0.0),
}


def after(flown: Four, seconds: float, start: VehicleMotion = HOVER, **terms: Any) -> VehicleMotion:
    steps = round(seconds / 0.01)
    return ForwardMotion(Contract(**terms)).after(start, [flown] * steps, 0.01)


@pytest.mark.parametrize("frame", ["ned_frd", "enu_flu"])
@pytest.mark.parametrize("kind", REST)
def test_a_vehicle_at_rest_stays_there(kind: Any, frame: Any) -> None:
    end = after(REST[kind], 0.5, action=kind, state_frame=frame)
    for value, expected in zip(end, HOVER, strict=True):
        assert value == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    ("kind", "action", "north_mps"),
    [
        # The lean needs some 0.2 s: less than 0.5 s of g tan(lean).
        ("sticks", (0.0, 0.0, 1.0, 0.0), 1.8),  # stick forward: 30 degrees
        ("attitude", (0.45, 0.0, -0.5, 0.0), 1.8),  # nose down
        ("rates", (0.39, 0.0, -1.0, 0.0), 0.9),  # nose down at 1 rad/s
        ("velocity", (3.0, 0.0, 0.0, 0.0), 1.9),
    ],
)
def test_actions_move_the_vehicle_forward(kind: Any, action: Four, north_mps: float) -> None:
    north, east, _ = after(action, 0.5, action=kind).velocity_ned_mps
    assert (north, east) == (pytest.approx(north_mps, abs=0.2), pytest.approx(0.0, abs=1e-6))


def test_a_stick_leans_towards_the_contracts_angle_and_climbs_at_its_rate() -> None:
    end = after((1.0, 0.0, 0.0, 0.5), 2.0, full_lean_deg=20.0, lean_dead_zone=0.0)
    w, x, _, _ = end.ned_from_body_wxyz
    assert math.degrees(2 * math.atan2(x, w)) == pytest.approx(10.0, abs=0.1)
    assert end.velocity_ned_mps[2] == pytest.approx(-2.5, abs=0.05)


def test_velocities_of_the_heading_follow_the_nose() -> None:
    start = HOVER._replace(ned_from_body_wxyz=HEADING_EAST)
    terms = {"action": "velocity", "velocity_frame": "heading"}
    north, east, _ = after((2.0, 0.0, 0.0, 0.0), 3.0, start, **terms).velocity_ned_mps
    assert (north, east) == (pytest.approx(0.0, abs=0.01), pytest.approx(2.0, abs=0.01))


def test_drag_goes_on_as_it_was_measured() -> None:
    start = HOVER._replace(specific_force_body_mps2=(-1.5, 0.0, -GRAVITY_MPS2))
    end = after(REST["sticks"], 0.2, start)
    assert end.velocity_ned_mps[0] == pytest.approx(-0.3)
    assert end.specific_force_body_mps2 == pytest.approx((-1.5, 0.0, -GRAVITY_MPS2))
