"""Gates are counted in imagination as on a course."""

import numpy as np

from benchmarks.rank_by_imagination import gates_passed
from sitl.course.layout import make_course

COURSE = make_course(3)


def through(first: int, last: int, *, east_m: float = 0.0) -> np.ndarray:
    """Straight from gate to gate, from a little before each to a little behind it."""
    points = []
    for gate in COURSE.gates[first : last + 1]:
        ahead = np.array([np.cos(gate.yaw_rad), np.sin(gate.yaw_rad), 0.0])
        right = np.array([-np.sin(gate.yaw_rad), np.cos(gate.yaw_rad), 0.0])
        center = np.array(gate.center_ned_m) + east_m * right
        points += [center - ahead, center + ahead]
    return np.array(points)


def test_a_path_through_the_openings_passes_them() -> None:
    assert gates_passed(through(0, 3), COURSE, 0) == 4
    assert gates_passed(through(2, 3), COURSE, 2) == 2


def test_gates_beside_the_path_or_out_of_order_do_not_count() -> None:
    assert gates_passed(through(0, 3, east_m=1.4), COURSE, 0) == 0
    assert gates_passed(through(2, 3), COURSE, 0) == 0
    assert gates_passed(through(2, 2)[::-1], COURSE, 2) == 0
