from dataclasses import replace
from math import pi, sqrt
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.fakes import level_telemetry, without
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import VehicleState
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.flight.state import Freshness, FrozenStateCheck, StateFrame, build_state

NOW_NS = 5_000_000_000
LIMITS = Freshness(attitude_ns=50 * NS_PER_MS, velocity_ns=100 * NS_PER_MS)
R = sqrt(0.5)


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
    )


def values(source: Telemetry, frame: StateFrame) -> list[float]:
    state = build_state(source, NOW_NS, frame=frame, freshness=LIMITS)
    assert isinstance(state, VehicleState)
    return state.values.tolist()


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
    assert values(source, frame) == pytest.approx(expected, abs=1e-6)


def rotation(q: list[float] | tuple[float, ...]) -> np.ndarray:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


ENU_FROM_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FRD_FROM_FLU = np.diag([1, -1, -1])


@given(st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01))
def test_enu_attitude_is_the_same_rotation_between_other_axes(q: tuple[float, ...]) -> None:
    unit = np.array(q) / np.linalg.norm(q)
    ours = rotation(values(telemetry(q=tuple(unit)), "enu_flu")[3:7])
    assert ours == pytest.approx(ENU_FROM_NED @ rotation(tuple(unit)) @ FRD_FROM_FLU, abs=1e-5)


@pytest.mark.parametrize(
    ("field", "what"),
    [
        ("ned_from_body_wxyz", "attitude"),
        ("rate_body_radps", "body rate"),
        ("velocity_ned_mps", "velocity"),
        ("specific_force_body_mps2", "acceleration"),
    ],
)
def test_a_missing_or_old_part_is_a_reason(field: str, what: str) -> None:
    good = level_telemetry(NOW_NS)
    missing = build_state(without(good, field), NOW_NS, frame="ned_frd", freshness=LIMITS)
    assert missing == because(Code.NO_READING, quantity=what)

    limit_ns = LIMITS.attitude_ns if what in ("attitude", "body rate") else LIMITS.velocity_ns
    reading = getattr(good, field)
    at_limit = good._replace(**{field: Reading(NOW_NS - limit_ns, reading.values)})
    old = good._replace(**{field: Reading(NOW_NS - limit_ns - 1, reading.values)})
    assert isinstance(
        build_state(at_limit, NOW_NS, frame="ned_frd", freshness=LIMITS), VehicleState
    )
    refused = build_state(old, NOW_NS, frame="ned_frd", freshness=LIMITS)
    limit_ms, age_ms = limit_ns / NS_PER_MS, (limit_ns + 1) / NS_PER_MS
    assert refused == because(Code.TOO_OLD, quantity=what, age_ms=age_ms, limit_ms=limit_ms)

    future = good._replace(**{field: Reading(NOW_NS, reading.values, delay_ns=-400 * NS_PER_MS)})
    for now_ns in (NOW_NS, NOW_NS + 40 * NS_PER_MS):
        assert build_state(future, now_ns, frame="ned_frd", freshness=LIMITS) == because(
            Code.READING_AHEAD, quantity=what, ahead_ms=400.0
        )


def test_a_reading_that_arrived_just_now_but_happened_long_ago_is_old() -> None:
    late = Reading(NOW_NS, (1.0, 0.0, 0.0, 0.0), delay_ns=LIMITS.attitude_ns)
    fresh = telemetry()._replace(ned_from_body_wxyz=late)
    state = build_state(fresh, NOW_NS, frame="ned_frd", freshness=LIMITS)
    assert isinstance(state, VehicleState)
    assert (state.attitude_ns, state.rate_ns) == (NOW_NS - LIMITS.attitude_ns, NOW_NS)
    refused = build_state(fresh, NOW_NS + 1, frame="ned_frd", freshness=LIMITS)
    assert isinstance(refused, Reason)


def test_each_part_keeps_its_own_stamp_and_the_array_is_frozen() -> None:
    source = telemetry()._replace(velocity_ned_mps=Reading(NOW_NS - 7, (0.0, 0.0, 0.0)))
    state = build_state(source, NOW_NS, frame="ned_frd", freshness=LIMITS)
    assert isinstance(state, VehicleState)
    assert (state.velocity_ns, state.attitude_ns) == (NOW_NS - 7, NOW_NS)
    assert state.values.dtype == np.float32
    with pytest.raises(ValueError, match="read-only"):
        state.values[0] = pi


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
    check, problem = FrozenStateCheck(max_frozen_ns=limit_ms * NS_PER_MS), None
    for step in range(round(100 * seconds) + 1):
        turned = rate_radps * step / 100 if moves else 0.0
        source = telemetry(
            q=(1.0, turned / 2, 0.0, 0.0),
            w=(rate_radps + step * rate_step_radps, 0.0, 0.0),
            a=(force_mps2, 0.0, -9.81),
        )
        state = build_state(source, NOW_NS, frame="ned_frd", freshness=LIMITS)
        assert isinstance(state, VehicleState)
        problem = check.problem(replace(state, attitude_ns=NOW_NS + step * 10 * NS_PER_MS))
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
