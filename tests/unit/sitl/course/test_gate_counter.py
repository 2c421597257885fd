import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sitl.course import LOOP_SEEDS, Course, Gate, GateCounter, make_course

NORTH_GATE = Gate(center_ned_m=(10.0, 0.0, -2.0), yaw_rad=0.0, size_m=2.0, index=0)
EAST_GATE = Gate(center_ned_m=(20.0, 5.0, -2.0), yaw_rad=math.pi / 2, size_m=2.0, index=1)
COURSE = Course(seed=0, gates=(NORTH_GATE, EAST_GATE))


def fly(counter: GateCounter, *positions, start_s=0.0):
    for second, position in enumerate(positions):
        counter.update(position, start_s + second)
    return [passed.index for passed in counter.passed]


@pytest.mark.parametrize(
    ("start", "end", "passed"),
    [
        pytest.param((9, 0, -2), (11, 0, -2), [0], id="through the middle"),
        pytest.param((9, 0, -2), (10, 0, -2), [0], id="ends in the plane"),
        pytest.param(
            (10, 0, -2), (11, 0, -2), [], id="starts in the plane: counted by the step before"
        ),
        pytest.param((11, 0, -2), (9, 0, -2), [], id="wrong direction"),
        pytest.param((8, 0, -2), (9.5, 0, -2), [], id="does not reach the plane"),
        pytest.param((9, 1, -3), (11, 1, -3), [0], id="exact corner, up and right"),
        pytest.param((9, -1, -1), (11, -1, -1), [0], id="exact corner, down and left"),
        pytest.param((9, 1.001, -2), (11, 1.001, -2), [], id="right of it"),
        pytest.param((9, 0, -3.001), (11, 0, -3.001), [], id="above it"),
        pytest.param((9, 0, -0.999), (11, 0, -0.999), [], id="below it"),
        pytest.param((9, 3, -2), (11, -3, -2), [0], id="slanted, inside in the plane"),
        pytest.param((9, 0, -2), (11, 2.1, -2), [], id="slanted, outside in the plane"),
        pytest.param((19, 5, -2), (21, 5, -2), [], id="along the plane of the next but one"),
        pytest.param((20, 4, -2), (20, 6, -2), [], id="second gate before the first"),
        pytest.param((9, 0, math.nan), (11, 0, -2), [], id="not a position"),
    ],
)
def test_one_step(start, end, passed):
    assert fly(GateCounter(COURSE), start, end) == passed


def test_gates_count_in_order_with_interpolated_times():
    counter = GateCounter(COURSE)
    fly(counter, (0, 0, -2), (16, 0, -2), (20, 4, -2), (20, 8, -2))
    assert [(passed.index, passed.t_s) for passed in counter.passed] == [(0, 0.625), (1, 2.25)]


def test_every_lap_of_a_loop_counts() -> None:
    course = make_course(LOOP_SEEDS + 4, laps=3)
    counter = GateCounter(course)
    centers = [gate.center_ned_m for gate in course.ahead(0, 30)]
    assert fly(counter, (0.0, 0.0, -2.0), *centers) == list(range(24))
    assert counter.next_gate is None


@given(st.integers(0, LOOP_SEEDS - 1))
def test_flying_centre_to_centre_passes_every_gate(seed):
    course = make_course(seed)
    counter = GateCounter(course)
    last = course.gates[-1]
    beyond = (
        last.center_ned_m[0] + math.cos(last.yaw_rad),
        last.center_ned_m[1] + math.sin(last.yaw_rad),
        last.center_ned_m[2],
    )
    centers = [gate.center_ned_m for gate in course.gates]
    assert fly(counter, (0.0, 0.0, -2.0), *centers, beyond) == list(range(len(course.gates)))
