"""Actions in the policy's axes and in the guard's, against the states in the same axes."""

import numpy as np
import pytest

from helpers.factories import make_plan
from mavbridge.core.vehicle import (
    Action,
    AttitudeThrust,
    BodyRates,
    Reading,
    Sticks,
    Telemetry,
    Velocity,
)
from mavbridge.flight.action_frames import action_frame
from mavbridge.flight.state import StateReader
from policy.contract import RATE, VELOCITY, ActionKind, Contract, StateFrame, VelocityFrame

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
    frame = action_frame(
        Contract(action=kind, velocity_frame=velocity_frame, state_frame="enu_flu")
    )
    sent = frame.to_guard(FOUR)
    assert type(sent[0]) is type(expected)
    assert sent[0] == expected
    np.testing.assert_array_equal(frame.from_guard(sent), FOUR)


@pytest.mark.parametrize("state_frame", ["ned_frd", "enu_flu"])
def test_an_action_that_repeats_the_state_asks_for_the_motion_of_now(
    state_frame: StateFrame,
) -> None:
    telemetry = Telemetry(
        ned_from_body_wxyz=Reading(0, (0.9, 0.1, -0.2, 0.3)),
        rate_body_radps=Reading(0, (0.1, 0.2, 0.3)),
        velocity_ned_mps=Reading(0, (1.0, 2.0, -3.0)),
        specific_force_body_mps2=Reading(0, (0.0, 0.0, -9.8)),
    )
    state = StateReader(make_plan(Contract(state_frame=state_frame))).motion(telemetry, 0)
    values = state.values  # type: ignore[union-attr]
    velocity = np.array([[*values[VELOCITY], values[RATE][2]]], np.float32)
    frame = action_frame(Contract(action="velocity", state_frame=state_frame))
    assert frame.to_guard(velocity)[0] == pytest.approx((1.0, 2.0, -3.0, 0.3))
    rates = np.array([[0.4, *values[RATE]]], np.float32)
    frame = action_frame(Contract(action="rates", state_frame=state_frame))
    assert frame.to_guard(rates)[0] == pytest.approx((0.4, 0.1, 0.2, 0.3))


def test_neutral_hovers_by_the_contracts_thrust() -> None:
    for kind, thrust in (("sticks", 0.0), ("velocity", 0.0), ("rates", 0.45), ("attitude", 0.45)):
        frame = action_frame(Contract(action=kind, hover_thrust=0.45))
        assert frame.neutral == (thrust, 0.0, 0.0, 0.0)
        np.testing.assert_array_equal(
            frame.from_guard([frame.neutral]), np.array([[thrust, 0, 0, 0]], np.float32)
        )
