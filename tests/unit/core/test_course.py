import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavbridge.core.course import CourseGate, CourseProgress, read_gates
from mavbridge.core.errors import UserError
from mavbridge.core.records import Position
from sitl.course import GateCounter, course_to_json, make_course

COURSE = make_course(3)
GATES = tuple(CourseGate(Position(*g.center_ned_m), g.yaw_rad, g.size_m) for g in COURSE.gates)
GATE = {"center_ned_m": [8, 0.5, -3], "yaw_rad": 0.1, "size_m": 2.4, "index": 0}


def test_the_simulators_courses_are_read_in_their_order(tmp_path: Path) -> None:
    course, path = make_course(1_000_007), tmp_path / "gates.json"
    path.write_text(course_to_json(course))
    expected = [CourseGate(Position(*g.center_ned_m), g.yaw_rad, g.size_m) for g in course.gates]
    assert list(read_gates(path)) == expected
    path.write_text(json.dumps({"gates": [GATE]}))  # from elsewhere: three keys are enough
    assert read_gates(path) == (CourseGate(Position(8.0, 0.5, -3.0), 0.1, 2.4),)


@pytest.mark.parametrize(
    "document",
    [
        [],
        {"gates": [7]},
        {"gates": [{}]},
        {"gates": [GATE | {"center_ned_m": [1, 2]}]},
        {"gates": [GATE | {"yaw_rad": float("nan")}]},
        {"gates": [GATE | {"size_m": 0}]},
    ],
)
def test_another_file_is_refused_with_the_command_that_makes_one(
    tmp_path: Path, document: Any
) -> None:
    path = tmp_path / "gates.json"
    path.write_text(json.dumps(document))
    with pytest.raises(UserError, match="sitl course --json"):
        read_gates(path)


def test_a_file_that_is_missing_or_no_json_is_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"--gates .*missing\.json: No such file"):
        read_gates(tmp_path / "missing.json")
    (tmp_path / "bad.json").write_text("gate north east")
    with pytest.raises(UserError, match="is not JSON"):
        read_gates(tmp_path / "bad.json")


NEAR = st.tuples(st.integers(0, 7), *[st.sampled_from((-1.3, -1.2, -0.5, 0.0, 0.7, 1.2))] * 3)
"""A gate, and a place around it: also on the very edge of the opening, and in its plane."""


def passed_by(path: list[Position]) -> list[tuple[int, float]]:
    """Gates that the bridge counts along a path of one position a second, and when."""
    progress = CourseProgress(GATES)
    for second, position in enumerate(path):
        progress.update(position, second * 1_000_000_000)
    return [(index, at_ns / 1e9) for index, at_ns in enumerate(progress.passed_ns)]


@given(st.lists(NEAR, min_size=2, max_size=40))
def test_the_bridge_and_the_simulator_count_the_same_gates(places: list[Any]) -> None:
    path = []
    for index, *offset_m in places:
        center = COURSE.gates[index].center_ned_m
        position = Position(*(a + b for a, b in zip(center, offset_m, strict=True)))
        path += [position] if not path or position != path[-1] else []
    truth = GateCounter(COURSE)
    for second, position in enumerate(path):
        truth.update(position, float(second))
    assert passed_by(path) == [
        (gate.index, pytest.approx(gate.t_s, abs=1e-8)) for gate in truth.passed
    ]


def test_a_whole_course_its_time_and_its_speed() -> None:
    path = [Position(0.0, 0.0, -2.0), *(gate.center_ned_m for gate in GATES)]
    progress = CourseProgress(GATES)
    assert progress.speed_mps is None
    for second, position in enumerate(path):
        assert not progress.is_done
        progress.update(position, second * 1_000_000_000)
    progress.update(Position(*path[-1][:2], -9.0), 9_000_000_000)
    assert progress.is_done
    legs_m = [math.dist(a.center_ned_m, b.center_ned_m) for a, b in pairwise(GATES)]
    assert progress.speed_mps == pytest.approx(sum(legs_m) / 7)


def test_a_path_that_was_interrupted_or_is_no_position_passes_nothing() -> None:
    before, after = Position(-1.0, 0.0, 0.0), Position(1.0, 0.0, 0.0)
    gate = CourseGate(Position(0.0, 0.0, 0.0), 0.0, 2.4)
    for path in ([before, None, after], [before, Position(1.0, math.nan, 0.0)], [after, before]):
        progress = CourseProgress([gate])
        for second, position in enumerate(path):
            progress.update(position, second)
        assert progress.passed_ns == []
    assert not CourseProgress([]).is_done
