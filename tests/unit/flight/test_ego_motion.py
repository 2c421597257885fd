"""What moved since the exposure: by hand, and as properties of any motion."""

from math import cos, pi, sin, sqrt

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from helpers.factories import make_state
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.records import VehicleState
from mavbridge.core.vehicle import Reading, Telemetry
from mavbridge.flight.ego_motion import MAX_READINGS, EgoMotion
from mavbridge.flight.state import Freshness, StateFrame, build_state

MS = NS_PER_MS
T0 = 7_000 * MS
FOR_EVER = Freshness(attitude_ns=10**12, velocity_ns=10**12)
NORTH = (1.0, 0.0, 0.0, 0.0)
EAST = (sqrt(0.5), 0.0, 0.0, sqrt(0.5))
FRAMES: tuple[StateFrame, ...] = ("ned_frd", "enu_flu")

quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 0.01)
velocities = st.tuples(*[st.floats(-20, 20)] * 3)


def state_at(
    at_ns: int,
    q: tuple[float, ...] = NORTH,
    v: tuple[float, ...] = (0.0, 0.0, 0.0),
    frame: StateFrame = "ned_frd",
    velocity_ns: int | None = None,
) -> VehicleState:
    """Attitude and velocity in NED/FRD, as the loop sees them in ``frame``."""
    telemetry = Telemetry(
        ned_from_body_wxyz=Reading(at_ns, q),
        rate_body_radps=Reading(at_ns, (0.0, 0.0, 0.0)),
        velocity_ned_mps=Reading(at_ns if velocity_ns is None else velocity_ns, v),
        specific_force_body_mps2=Reading(at_ns, (0.0, 0.0, -9.8)),
    )
    state = build_state(telemetry, at_ns, frame=frame, freshness=FOR_EVER)
    assert isinstance(state, VehicleState)
    return state


def since(states: list[VehicleState], exposed_ns: int, span_ns: int = 300 * MS) -> list[float]:
    """The seven numbers at the last state, after all were pushed."""
    motion = EgoMotion(span_ns=span_ns)
    for state in states:
        motion.push(state)
    out = motion.append_to(states[-1], exposed_ns)
    assert (out.shape, out.dtype) == ((1, 20), np.float32)
    np.testing.assert_array_equal(out[0, :13], states[-1].values)
    return [float(value) for value in out[0, 13:]]


def turned(q: tuple[float, ...], axis: int, angle: float) -> tuple[float, ...]:
    """``q`` and then a rotation about an axis of the body."""
    turn = [cos(angle / 2), 0.0, 0.0, 0.0]
    turn[1 + axis] = sin(angle / 2)
    w, x, y, z = q
    a, b, c, d = turn
    return (
        w * a - x * b - y * c - z * d,
        w * b + x * a + y * d - z * c,
        w * c - x * d + y * a + z * b,
        w * d + x * c - y * b + z * a,
    )


@pytest.mark.parametrize(
    ("frame", "rotation", "change"),
    [
        # A quarter turn to the right about the down axis; north is then, and only then, ahead.
        ("ned_frd", [0, 0, pi / 2], [3, 0, 0]),
        ("enu_flu", [0, 0, -pi / 2], [3, 0, 0]),
    ],
)
def test_a_quarter_turn_to_the_right_with_a_push_north(
    frame: StateFrame, rotation: list[float], change: list[float]
) -> None:
    states = [
        state_at(T0, NORTH, (1, 0, 0), frame),
        state_at(T0 + 100 * MS, EAST, (4, 0, 0), frame),
    ]
    assert since(states, T0) == pytest.approx([0.1, *rotation, *change], abs=1e-6)
    # Half way there it was turned by half of it, and ahead was north-east.
    ahead, right = 1.5 * sqrt(0.5), -1.5 * sqrt(0.5)
    side = right if frame == "ned_frd" else -right
    half = [0.05, *(part / 2 for part in rotation), ahead, side, 0]
    assert since(states, T0 + 50 * MS) == pytest.approx(half, abs=1e-6)


def test_every_part_goes_by_its_own_stamp() -> None:
    """Velocity comes every 20 ms: at even acceleration its stamps give the exact change."""
    states = [
        state_at(T0 + t * MS, v=(0, 0, (t // 20 * 20) / 10), velocity_ns=T0 + t // 20 * 20 * MS)
        for t in range(0, 110, 10)
    ]
    assert since(states, T0 + 53 * MS) == pytest.approx([0.047, 0, 0, 0, 0, 0, 4.7], abs=1e-6)


def test_outside_of_what_is_known_nothing_moves_and_the_age_is_told_as_it_is() -> None:
    states = [state_at(T0, NORTH), state_at(T0 + 100 * MS, EAST, (1, 0, 0))]
    before = since(states, T0 - 50 * MS)
    assert before == pytest.approx([0.15, 0, 0, pi / 2, 1, 0, 0], abs=1e-6)
    newer = since(states, T0 + 104 * MS)
    assert newer == pytest.approx([-0.004, 0, 0, 0, 0, 0, 0], abs=1e-6)
    alone = since([state_at(T0, EAST, (1, 2, 3))], T0 - 30 * MS)
    assert alone == pytest.approx([0.03, 0, 0, 0, 0, 0, 0])


def test_a_reading_seen_at_two_ticks_counts_once() -> None:
    states = [state_at(T0), state_at(T0 + 20 * MS, EAST), state_at(T0 + 20 * MS, EAST)]
    assert since(states, T0 + 10 * MS)[3] == pytest.approx(pi / 4, abs=1e-6)


def test_what_is_remembered_is_bounded_and_reaches_over_the_span() -> None:
    motion = EgoMotion(span_ns=300 * MS)
    for k in range(5000):
        motion.push(make_state(T0 + k * 10 * MS))
    assert len(motion._attitudes) == 31
    fast = EgoMotion(span_ns=10**15)
    for k in range(2 * MAX_READINGS):
        fast.push(make_state(T0 + k))
    assert len(fast._velocities) == MAX_READINGS
    # After a silence longer than the span, the reading before it still bounds the exposure.
    states = [state_at(T0), state_at(T0 + 1000 * MS, EAST)]
    assert since(states, T0 + 800 * MS)[3] == pytest.approx(pi / 2 * 0.2, abs=1e-6)


def test_nothing_can_be_said_before_the_first_state() -> None:
    with pytest.raises(ValueError, match="no state was pushed"):
        EgoMotion(span_ns=1).append_to(make_state(), 0)


def rotation_matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q / np.linalg.norm(q)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def exponential(rotation: np.ndarray) -> np.ndarray:
    """Rodrigues' formula."""
    angle = float(np.linalg.norm(rotation))
    x, y, z = rotation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-9:
        return np.eye(3) + cross
    return np.eye(3) + sin(angle) / angle * cross + (1 - cos(angle)) / angle**2 * cross @ cross


@given(quaternions, quaternions, velocities, velocities, st.sampled_from(FRAMES))
def test_the_motion_leads_from_the_exposure_to_the_state(
    q0: tuple[float, ...],
    q1: tuple[float, ...],
    v0: tuple[float, ...],
    v1: tuple[float, ...],
    frame: StateFrame,
) -> None:
    then, now = state_at(T0, q0, v0, frame), state_at(T0 + 50 * MS, q1, v1, frame)
    seen = np.array(since([then, now], T0))
    rotation, change = seen[1:4], seen[4:7]
    assert np.linalg.norm(rotation) <= pi + 1e-5
    was = rotation_matrix(then.values[3:7])
    assert was @ exponential(rotation) == pytest.approx(rotation_matrix(now.values[3:7]), abs=1e-4)
    assert then.values[:3] + was @ change == pytest.approx(now.values[:3], abs=1e-4)


@given(quaternions, st.tuples(*[st.floats(-1, 1)] * 3), velocities, st.floats(0, 1))
def test_both_frames_tell_of_one_motion(
    q0: tuple[float, ...], turn: tuple[float, ...], v1: tuple[float, ...], share: float
) -> None:
    q1 = turned(turned(turned(q0, 0, turn[0]), 1, turn[1]), 2, turn[2])
    frd, flu = (
        since(
            [state_at(T0, q0, frame=frame), state_at(T0 + 100 * MS, q1, v1, frame)],
            T0 + round(share * 100 * MS),
        )
        for frame in FRAMES
    )
    mirrored = np.array(frd) * [1, 1, -1, -1, 1, -1, -1]
    assert flu == pytest.approx(mirrored, abs=1e-4)
