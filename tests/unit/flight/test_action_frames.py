"""Actions in the policy's axes and in the guard's, against the states in the same axes."""

import numpy as np
import pytest

from mavbridge.core.vehicle import Action, AttitudeThrust, BodyRates, Sticks, Velocity
from mavbridge.flight.history import ActionFrame
from policy.contract import ActionKind, Contract, VelocityFrame

FOUR = np.array([[0.5, 1.0, 2.0, 3.0], [0.25, -4.0, 5.0, -6.0]], np.float32)


@pytest.mark.parametrize(
    ("kind", "velocity_frame", "expected"),
    [
        ("sticks", "world", Sticks(0.5, 1.0, 2.0, 3.0)),
        ("rates", "world", BodyRates(0.5, 1.0, -2.0, -3.0)),
        ("attitude", "world", AttitudeThrust(0.5, 1.0, -2.0, -3.0)),
        ("velocity", "world", Velocity(1.0, 0.5, -2.0, -3.0)),
        ("velocity", "heading", Velocity(0.5, -1.0, -2.0, -3.0)),
    ],
)
def test_actions_in_ros_axes_by_hand_and_back(
    kind: ActionKind, velocity_frame: VelocityFrame, expected: Action
) -> None:
    frame = ActionFrame(Contract(action=kind, velocity_frame=velocity_frame, state_frame="enu_flu"))
    sent = frame.to_guard(FOUR)
    assert type(sent[0]) is type(expected)
    assert sent[0] == expected
    np.testing.assert_array_equal(frame.from_guard(sent), FOUR)


def test_neutral_hovers_by_the_contracts_thrust() -> None:
    for kind, thrust in (("sticks", 0.0), ("velocity", 0.0), ("rates", 0.45), ("attitude", 0.45)):
        frame = ActionFrame(Contract(action=kind, hover_thrust=0.45))
        assert frame.neutral == (thrust, 0.0, 0.0, 0.0)
        np.testing.assert_array_equal(
            frame.from_guard([frame.neutral]), np.array([[thrust, 0, 0, 0]], np.float32)
        )
