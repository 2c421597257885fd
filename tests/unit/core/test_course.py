import json
from pathlib import Path
from typing import Any

import pytest

from mavbridge.core.course import CourseGate, read_gates
from mavbridge.core.errors import UserError
from mavbridge.core.records import Position
from sitl.course.layout import course_to_json, make_course

GATE = {"center_ned_m": [8, 0.5, -3], "yaw_rad": 0.1, "size_m": 2.4, "index": 0}


def test_the_simulators_courses_are_read_in_their_order(tmp_path: Path) -> None:
    course, path = make_course(1_000_007), tmp_path / "gates.json"
    path.write_text(course_to_json(course))
    expected = [CourseGate(Position(*g.center_ned_m), g.yaw_rad, g.size_m) for g in course.gates]
    assert list(read_gates(path)) == expected


def test_gates_from_elsewhere_need_three_keys(tmp_path: Path) -> None:
    path = tmp_path / "gates.json"
    path.write_text(json.dumps({"gates": [GATE]}))
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
