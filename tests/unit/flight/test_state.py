"""The contract's state from telemetry: axes, freshness, optional inputs, frozen attitudes."""

from dataclasses import replace
from math import pi, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.factories import make_plan
from helpers.fakes import level_telemetry
from mavbridge.config.policy import Rates
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.errors import UserError
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import VehicleState
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.flight.state import FrozenStateCheck, StateReader, keeps_past, motion_since
from policy.contract import Contract, StateExtra, StateFrame

MS = NS_PER_MS
NOW_NS = 5_000 * MS
R = sqrt(0.5)
GOAL = "100,20,-30"
FRAMES: tuple[StateFrame, ...] = ("ned_frd", "enu_flu")

quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01)
velocities = st.tuples(*[st.floats(-20, 20)] * 3)


def telemetry(
    v: tuple[float, ...] = (0.0, 0.0, 0.0),
    q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0),
    w: tuple[float, ...] = (0.0, 0.0, 0.0),
    a: tuple[float, ...] = (0.0, 0.0, -9.81),
) -> Telemetry:
    return Telemetry(
        velocity_ned_mps=Reading(NOW_NS, v),
        ned_from_body_wxyz=Reading(NOW_NS, q),
        rate_body_radps=Reading(NOW_NS, w),
        specific_force_body_mps2=Reading(NOW_NS, a),
        position_ned_m=Reading(NOW_NS, (10, 50, -12)),
        height_above_home_m=Reading(NOW_NS, (11.5,)),
    )


def read(
    source: Telemetry,
    *extras: StateExtra,
    frame: StateFrame = "ned_frd",
    has_position: bool = True,
) -> VehicleState | Reason:
    contract = Contract(state_extras=extras, state_frame=frame)
    plan = make_plan(contract, goal=GOAL if "goal" in extras else None)
    return StateReader(plan).read(source, NOW_NS, has_position=has_position)


def state_of(*args: Any, **settings: Any) -> VehicleState:
    state = read(*args, **settings)
    assert isinstance(state, VehicleState)
    return state


@pytest.mark.parametrize(
    ("source", "frame", "expected"),
    [
        # level, facing north, 1 m/s north, 2 east, 3 down
        (telemetry(v=(1, 2, 3)), "ned_frd", [1, 2, 3, 1, 0, 0, 0, 0, 0, 0, 0, 0, -9.81]),
        # the same in ENU: east, north, up; facing north is a quarter turn left from east
        (telemetry(v=(1, 2, 3)), "enu_flu", [2, 1, -3, R, 0, 0, R, 0, 0, 0, 0, 0, 9.81]),
        # facing east is ENU's zero attitude
        (telemetry(q=(R, 0, 0, R)), "enu_flu", [0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, 0, 9.81]),
        # nose up 90 deg while facing north: in ENU/FLU a yaw of 90 then a pitch of -90 (FLU y is
        # left): (R,0,0,R)*(R,0,-R,0) = (0.5, 0.5, -0.5, 0.5)
        (
            telemetry(q=(R, 0, R, 0)),
            "enu_flu",
            [0, 0, 0, 0.5, 0.5, -0.5, 0.5, 0, 0, 0, 0, 0, 9.81],
        ),
        # body axes: right and down become left and up
        (
            telemetry(w=(0.1, 0.2, 0.3), a=(1, 2, 3)),
            "enu_flu",
            [0, 0, 0, R, 0, 0, R, 0.1, -0.2, -0.3, 1, -2, -3],
        ),
        # q and -q are one attitude; lengths are corrected
        (telemetry(q=(1, 1, 1, 1)), "ned_frd", [0, 0, 0, *(0.5,) * 4, 0, 0, 0, 0, 0, -9.81]),
        # half a turn has no sign of w to be told by
        (telemetry(q=(0, 1, 0, 0)), "ned_frd", [0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0, 0, -9.81]),
        (
            telemetry(q=(-2 * R, 0, 0, -2 * R)),
            "ned_frd",
            [0, 0, 0, R, 0, 0, R, 0, 0, 0, 0, 0, -9.81],
        ),
    ],
)
def test_hand_computed_states(source: Telemetry, frame: StateFrame, expected: list[float]) -> None:
    assert state_of(source, frame=frame).values.tolist() == pytest.approx(expected, abs=1e-6)


def rotation(q: Any) -> np.ndarray:
    w, x, y, z = np.array(q) / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


ENU_FROM_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FRD_FROM_FLU = np.diag([1, -1, -1])


@given(quaternions)
def test_enu_attitude_is_the_same_rotation_between_other_axes(q: tuple[float, ...]) -> None:
    ours = rotation(state_of(telemetry(q=q), frame="enu_flu").values[3:7])
    assert ours == pytest.approx(ENU_FROM_NED @ rotation(q) @ FRD_FROM_FLU, abs=1e-5)


@pytest.mark.parametrize(
    ("field", "what", "limit_ms", "extra"),
    [
        ("ned_from_body_wxyz", "attitude", 100, None),
        ("rate_body_radps", "body rate", 100, None),
        ("velocity_ned_mps", "velocity", 250, None),
        ("specific_force_body_mps2", "acceleration", 250, None),
        ("position_ned_m", "position", 250, "goal"),
        ("position_ned_m", "position", 250, "altitude"),
        ("height_above_home_m", "height above home", 250, "height"),
    ],
)
def test_a_missing_old_or_future_part_is_a_reason_and_never_a_zero(
    field: str, what: str, limit_ms: int, extra: StateExtra | None
) -> None:
    extras: tuple[StateExtra, ...] = () if extra is None else (extra,)
    known, limit_ns = getattr(telemetry(), field).values, limit_ms * MS

    def read_with(reading: Reading | None) -> VehicleState | Reason:
        return read(telemetry()._replace(**{field: reading}), *extras)

    code = Code.NO_READING if extra is None else Code.NO_TRUSTED_READING
    assert read_with(None) == because(code, quantity=what)
    # Half of the age passed on the way here.
    at_limit = Reading(NOW_NS - limit_ns // 2, known, limit_ns // 2)
    assert isinstance(read_with(at_limit), VehicleState)
    old = because(Code.TOO_OLD, quantity=what, age_ms=limit_ms + 1e-6, limit_ms=float(limit_ms))
    assert read_with(at_limit._replace(delay_ns=limit_ns // 2 + 1)) == old
    assert read_with(Reading(NOW_NS - limit_ns - 1, known)) == old
    if extra is None:  # whatever else is asked for
        without = telemetry()._replace(**{field: None})
        assert read(without, "height") == because(code, quantity=what)
    ahead = because(Code.READING_AHEAD, quantity=what, ahead_ms=400.0)
    assert read_with(Reading(NOW_NS, known, -400 * MS)) == ahead


def test_each_part_keeps_its_own_stamp_and_the_array_is_frozen() -> None:
    source = telemetry()._replace(
        velocity_ned_mps=Reading(NOW_NS - 7, (0.0, 0.0, 0.0)),
        ned_from_body_wxyz=Reading(NOW_NS - 1, (1.0, 0.0, 0.0, 0.0), 4),
    )
    state = state_of(source)
    assert (state.velocity_ns, state.attitude_ns) == (NOW_NS - 7, NOW_NS - 5)
    assert (state.rate_ns, state.specific_force_ns) == (NOW_NS, NOW_NS)
    assert (state.extras, state.extras_ns) == ((), None)
    assert state.values.dtype == np.float32
    with pytest.raises(ValueError, match="read-only"):
        state.values[0] = pi


@pytest.mark.parametrize(
    ("frame", "goal"), [("ned_frd", (90, -30, -18)), ("enu_flu", (-30, 90, 18))]
)
def test_extras_follow_in_the_contracts_order_and_axes(
    frame: StateFrame, goal: tuple[float, ...]
) -> None:
    source = telemetry()._replace(height_above_home_m=Reading(NOW_NS - 60 * MS, (11.5,)))
    state = state_of(source, "height", "goal", "altitude", frame=frame)
    assert (state.extras, state.extras_ns) == ((11.5, *goal, 12.0), NOW_NS - 60 * MS)
    np.testing.assert_array_equal(state.values, state_of(source, frame=frame).values)


def test_a_position_that_the_estimator_does_not_trust_is_none() -> None:
    for extra in ("goal", "altitude"):
        assert isinstance(read(telemetry(), extra, has_position=False), Reason)  # type: ignore[arg-type]
    assert isinstance(read(telemetry(), "height", has_position=False), VehicleState)


def test_a_goal_is_given_just_where_the_policy_takes_one() -> None:
    assert make_plan(Contract(state_extras=("goal",)), goal="-10.5, 2,-3").config.goal_ned_m == (
        *(-10.5, 2.0, -3.0),
    )
    with pytest.raises(UserError, match="this policy flies to a goal: give --goal"):
        make_plan(Contract(state_extras=("goal",)))
    with pytest.raises(UserError, match="takes no goal"):
        make_plan(goal=GOAL)


@pytest.mark.parametrize(
    ("extras", "height", "position"),
    [
        ((), False, False),
        (("height",), True, False),
        (("altitude",), False, True),
        (("goal", "height"), True, True),
    ],
)
def test_the_guard_asks_for_what_the_policy_takes(
    extras: tuple[StateExtra, ...], height: bool, position: bool
) -> None:
    goal = GOAL if "goal" in extras else None
    settings = make_plan(Contract(state_extras=extras), goal=goal).guard
    assert (settings.watches_home_height, settings.watches_position) == (height, position)


def test_states_between_solves_are_kept_where_something_asks_for_them() -> None:
    moving = Contract(since_exposure=True)
    assert not keeps_past(make_plan(moving, rates=Rates(action_rate=20.0)))
    assert keeps_past(make_plan(moving, rates=Rates(action_rate=19.9)))
    assert keeps_past(make_plan(Contract(observation_steps=2)))
    assert not keeps_past(make_plan(rates=Rates(action_rate=19.9)))


# --- motion since the exposure


def moved(
    after_ms: float,
    q: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0),
    v: tuple[float, ...] = (0.0, 0.0, 0.0),
    frame: StateFrame = "ned_frd",
    velocity_ms: float | None = None,
) -> VehicleState:
    """Attitude and velocity in NED/FRD, as the loop sees them in ``frame``."""
    at_ns = NOW_NS + round(after_ms * MS)
    velocity_ns = at_ns if velocity_ms is None else NOW_NS + round(velocity_ms * MS)
    state = state_of(telemetry(v, q), frame=frame)
    return replace(state, attitude_ns=at_ns, velocity_ns=velocity_ns)


def since(states: list[VehicleState], after_ms: float) -> list[float]:
    """The seven numbers at the last state, from an exposure after NOW_NS."""
    out = motion_since(NOW_NS + round(after_ms * MS), states[-1], states)
    assert (out.shape, out.dtype) == ((7,), np.float32)
    return [float(value) for value in out]


EAST = (R, 0.0, 0.0, R)


@pytest.mark.parametrize(
    ("states", "after_ms", "expected"),
    [
        pytest.param(
            # Velocity comes every 20 ms: its stamps give the exact change.
            [moved(t, v=(0, 0, t // 20 * 2), velocity_ms=t // 20 * 20) for t in range(0, 110, 10)],
            53,
            [0.047, 0, 0, 0, 0, 0, 4.7],
            id="each part by its own stamp",
        ),
        ([moved(0), moved(100, EAST, (1, 0, 0))], -50, [0.15, 0, 0, pi / 2, 1, 0, 0]),
        ([moved(0), moved(100, EAST, (1, 0, 0))], 104, [-0.004, 0, 0, 0, 0, 0, 0]),
        ([moved(0, EAST, (1, 2, 3))], -30, [0.03, 0, 0, 0, 0, 0, 0]),
        ([moved(0), moved(20, EAST), moved(20, EAST)], 10, [0.01, 0, 0, pi / 4, 0, 0, 0]),
        ([moved(0), moved(1000, EAST)], 800, [0.2, 0, 0, pi / 2 * 0.2, 0, 0, 0]),
    ],
)
def test_motion_is_even_between_two_states_and_none_outside(
    states: list[VehicleState], after_ms: float, expected: list[float]
) -> None:
    assert since(states, after_ms) == pytest.approx(expected, abs=1e-6)


def exponential(turn: np.ndarray) -> np.ndarray:
    angle = max(float(np.linalg.norm(turn)), 1e-12)
    return rotation((np.cos(angle / 2), *np.sin(angle / 2) / angle * turn))


@given(quaternions, quaternions, velocities, velocities, st.sampled_from(FRAMES))
def test_the_motion_leads_from_the_exposure_to_the_state(
    q0: tuple[float, ...],
    q1: tuple[float, ...],
    v0: tuple[float, ...],
    v1: tuple[float, ...],
    frame: StateFrame,
) -> None:
    then, now = moved(0, q0, v0, frame), moved(50, q1, v1, frame)
    seen = np.array(since([then, now], 0))
    turn, change = seen[1:4], seen[4:7]
    assert np.linalg.norm(turn) <= pi + 1e-5
    was = rotation(then.values[3:7])
    assert was @ exponential(turn) == pytest.approx(rotation(now.values[3:7]), abs=1e-4)
    assert then.values[:3] + was @ change == pytest.approx(now.values[:3], abs=1e-4)


# --- a frozen attitude


def frozen_for(
    seconds: float,
    rate_radps: float,
    *,
    moves: bool = False,
    rate_step_radps: float = 0.0,
    force_mps2: float = 0.0,
    limit_ms: int = 500,
) -> Reason | None:
    """What the check says of the last of these states, at 100 Hz."""
    check, problem = FrozenStateCheck(max_frozen_ns=limit_ms * MS), None
    state = state_of(level_telemetry(NOW_NS))
    for step in range(round(100 * seconds) + 1):
        values = state.values.copy()
        values[4] = rate_radps * step / 200 if moves else 0.0
        values[7] = rate_radps + step * rate_step_radps
        values[10] = force_mps2
        problem = check.problem(replace(state, values=values, attitude_ns=NOW_NS + step * 10 * MS))
    return problem


def test_a_frozen_attitude_is_told_with_its_figures() -> None:
    frozen = because(Code.ATTITUDE_FROZEN, age_ms=520.0, limit_ms=500.0)
    assert frozen_for(0.52, 0.01) == frozen


@pytest.mark.parametrize(
    ("seconds", "rate_radps", "changes", "is_frozen"),
    [
        pytest.param(0.5, 0.01, {}, False, id="at the limit"),
        pytest.param(5.0, 2e-4, {"moves": True}, False, id="turns slowly"),
        pytest.param(5.0, 0.0, {}, False, id="rests"),
        pytest.param(5.0, 0.0, {"force_mps2": 1.0}, False, id="a force is no turn"),
        pytest.param(1.0, 0.9e-4, {}, False, id="less than a turn"),
        pytest.param(1.0, 1.1e-4, {}, True, id="a turn"),
        pytest.param(0.59, 0.01, {"rate_step_radps": 0.001}, True, id="the rates change"),
        pytest.param(5.0, 1.0, {"limit_ms": 0}, False, id="switched off"),
    ],
)
def test_an_attitude_that_stays_the_same_while_the_vehicle_turns_is_frozen(
    seconds: float, rate_radps: float, changes: dict[str, Any], is_frozen: bool
) -> None:
    assert (frozen_for(seconds, rate_radps, **changes) is not None) is is_frozen
