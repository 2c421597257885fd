"""Bounds by kind of action, and the actions that are safe in themselves."""

import math
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.guard_facts import limits_of, stick_smoothing
from mavbridge.core.rotation import quaternion_from_euler, tilt_rad
from mavbridge.core.vehicle import (
    ACTION_CLASSES,
    IDLE,
    NEUTRAL,
    Action,
    ActionKind,
    ActionMeaning,
    AttitudeThrust,
    BodyRates,
    Reading,
    Sticks,
    Telemetry,
    Velocity,
)
from mavbridge.guard.limits import (
    ActionSmoother,
    Smoothing,
    first_action,
    idle_action,
    neutral_action,
)
from mavbridge.mavlink.codec.packets import MOST_LEAN_RAD

SETTINGS = {
    "setpoint_lean": math.degrees(0.5),
    "setpoint_rate": math.degrees(3.0),
    "setpoint_yaw_rate": math.degrees(1.0),
    "setpoint_thrust": 0.8,
    "setpoint_speed": 5.0,
    "setpoint_climb": 2.0,
}
FAR = 100.0
KINDS: tuple[ActionKind, ...] = get_args(ActionKind)
number = st.floats(-FAR, FAR)
four = st.tuples(number, number, number, number)


@pytest.mark.parametrize(
    ("far", "bound"),
    [
        (Sticks(FAR, -FAR, 0.5, FAR), Sticks(1.0, -1.0, 0.5, 1.0)),
        (BodyRates(FAR, -FAR, FAR, -FAR), BodyRates(0.8, -3.0, 3.0, -1.0)),
        (BodyRates(-FAR, 0.0, 0.0, 0.0), BodyRates(0.0, 0.0, 0.0, 0.0)),
        (AttitudeThrust(0.5, 0.3, 0.4, FAR), AttitudeThrust(0.5, 0.3, 0.4, 1.0)),
        (AttitudeThrust(0.5, 3.0, -4.0, 0.0), AttitudeThrust(0.5, 0.3, -0.4, 0.0)),
        (Velocity(30.0, -40.0, -FAR, 0.0), Velocity(3.0, -4.0, -2.0, 0.0)),
    ],
)
def test_each_kind_is_clipped_by_its_own_bounds_and_a_vector_keeps_its_direction(
    far: Action, bound: Action
) -> None:
    kind = next(kind for kind, one in ACTION_CLASSES.items() if isinstance(far, one))
    clipped = limits_of(kind, **SETTINGS).clip(far)
    assert type(clipped) is type(bound)
    assert clipped == pytest.approx(bound)


@given(kind=st.sampled_from(KINDS), start=four, goal=four, dt_s=st.floats(0.0, 0.2))
def test_no_number_changes_faster_than_its_limit_nor_beyond_the_goal(
    kind: ActionKind, start: tuple[float, ...], goal: tuple[float, ...], dt_s: float
) -> None:
    limits, make = limits_of(kind, **SETTINGS), ACTION_CLASSES[kind]
    now, wanted = limits.clip(make(*start)), limits.clip(make(*goal))
    moved = limits.approach(now, wanted, dt_s)
    for a, b, goal_value, rate in zip(now, moved, wanted, limits.change_per_s, strict=True):
        assert abs(b - a) <= rate * dt_s + 1e-9 if rate < math.inf else b == goal_value
        assert min(a, goal_value) - 1e-9 <= b <= max(a, goal_value) + 1e-9


def test_a_velocity_is_changed_within_the_acceleration_in_any_direction() -> None:
    moved = limits_of("velocity", **SETTINGS).approach(
        Velocity(0.0, 0.0, 0.0, 0.0), Velocity(3.0, 4.0, -2.0, 1.0), 0.1
    )
    assert moved == pytest.approx(Velocity(0.3, 0.4, -0.5, 1.0))


HOVER, DOWN = AttitudeThrust(0.3, 0.0, 0.0, 0.0), AttitudeThrust(0.0, 0.0, 0.0, 0.0)
REST = Velocity(0.0, 0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("kind", "neutral", "idle"),
    [
        ("sticks", NEUTRAL, IDLE),
        ("rates", HOVER, DOWN),
        ("attitude", HOVER, DOWN),
        ("velocity", REST, REST),
    ],
)
def test_neutral_is_level_or_at_rest_and_idle_stays_on_the_ground(
    kind: ActionKind, neutral: Action, idle: Action
) -> None:
    meaning = ActionMeaning(kind=kind, hover_thrust=0.3)
    for found, wanted in ((neutral_action(meaning), neutral), (idle_action(meaning), idle)):
        assert (type(found), found) == (type(wanted), wanted)


def test_a_slew_of_0_is_no_limit() -> None:
    assert limits_of("sticks").change_per_s == (8.0,) * 4
    assert stick_smoothing(max_slew_per_s=0.0).limits.change_per_s == (math.inf,) * 4


MOVING = Telemetry(velocity_ned_mps=Reading(0, (1.0, 2.0, -0.5)))
LEANING = Telemetry(ned_from_body_wxyz=Reading(0, (math.cos(0.1), math.sin(0.1), 0.0, 0.0)))
TURNED = Telemetry(
    ned_from_body_wxyz=Reading(0, quaternion_from_euler(0.0, 0.0, math.radians(30.0))),
    velocity_ned_mps=Reading(0, (3.0, 2.0, -0.5)),
)
"""The nose points 30 degrees to the east of north."""
PILOT = Sticks(0.1, 0.2, 0.3, 0.4)
AHEAD = ActionMeaning(kind="velocity", is_heading_frame=True)


@pytest.mark.parametrize(
    ("meaning", "telemetry", "sticks", "first"),
    [
        (ActionMeaning(), TURNED, PILOT, PILOT),
        (ActionMeaning(), TURNED, None, NEUTRAL),
        (ActionMeaning(kind="rates"), TURNED, None, (0.39, 0.0, 0.0, 0.0)),
        (ActionMeaning(kind="attitude"), LEANING, None, (0.39, 0.2, 0.0, 0.0)),
        (ActionMeaning(kind="velocity"), TURNED, None, (3.0, 2.0, -0.5, 0.0)),
        # 3 cos 30 + 2 sin 30 to the front, 2 cos 30 - 3 sin 30 to the right
        (AHEAD, TURNED, None, (3.598076, 0.232051, -0.5, 0.0)),
        # What the vehicle has not said: level, at rest, north.
        (ActionMeaning(kind="attitude"), Telemetry(), None, (0.39, 0.0, 0.0, 0.0)),
        (ActionMeaning(kind="velocity"), Telemetry(), None, (0.0, 0.0, 0.0, 0.0)),
        (AHEAD, MOVING, None, (1.0, 2.0, -0.5, 0.0)),
    ],
)
def test_a_flight_begins_with_what_the_vehicle_does(
    meaning: ActionMeaning, telemetry: Telemetry, sticks: Sticks | None, first: tuple[float, ...]
) -> None:
    assert first_action(meaning, telemetry, sticks) == pytest.approx(first, abs=1e-6)


@pytest.mark.parametrize(("roll_rad", "pitch_rad"), [(1.54, 0.0), (3.0, -1.2), (0.1, 1.55)])
def test_an_attitude_that_begins_on_its_side_can_be_sent(roll_rad: float, pitch_rad: float) -> None:
    """The codec ends the guard where it is given more."""
    side = Reading(0, quaternion_from_euler(roll_rad, pitch_rad, 0.7))
    first = first_action(ActionMeaning(kind="attitude"), Telemetry(ned_from_body_wxyz=side), None)
    assert isinstance(first, AttitudeThrust)
    sent = quaternion_from_euler(first.roll_rad, first.pitch_rad, 0.7)
    assert 0.5 < tilt_rad(sent) < MOST_LEAN_RAD
    assert math.copysign(1, first.roll_rad) == math.copysign(1, roll_rad)


@pytest.mark.parametrize("tau_s", [0.0, 0.05])
def test_body_rates_stay_body_rates_although_they_start_from_an_idle_attitude(
    tau_s: float,
) -> None:
    """Their numbers under the name of an attitude would be a lean."""
    limits = limits_of("rates")
    smoother = ActionSmoother(
        Smoothing(limits=limits, tau_s=tau_s), idle_action(ActionMeaning(kind="rates"))
    )
    for tick in range(4):
        trace = smoother.step(BodyRates(0.4, 1.5, -1.0, 0.5), tick * 10_000_000)
        stages = (trace.raw, trace.clipped, trace.slewed, trace.smoothed)
        assert {type(action) for action in stages} == {BodyRates}
