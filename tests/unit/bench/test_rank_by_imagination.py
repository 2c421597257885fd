"""Gates are counted in imagination as on a course."""

import numpy as np

from benchmarks.rank_by_imagination import Gate, gates_passed


def gate(north_m: float, east_m: float = 0.0, heading_rad: float = 0.0) -> Gate:
    return Gate(
        center_ned_m=np.array([north_m, east_m, -2.0]),
        along_ned=np.array([np.cos(heading_rad), np.sin(heading_rad), 0.0]),
    )


def path(*points: tuple[float, float, float]) -> np.ndarray:
    return np.array(points, dtype=np.float64)


def test_a_path_through_the_openings_passes_them_in_order() -> None:
    gates = (gate(5), gate(10, 1), gate(20))
    assert gates_passed(path((0, 0, -2), (4, 0, -2), (9, 0.5, -2.5), (12, 1, -2)), gates) == 2


def test_it_ends_at_a_gate_that_is_passed_beside_above_or_below_its_opening() -> None:
    gates = (gate(5), gate(10))
    for missed in ((5.0, 1.4, -2.0), (5.0, 0.0, -3.4), (5.0, 0.0, -0.7)):
        assert gates_passed(path((0, 0, -2), missed, (6, 0, -2), (11, 0, -2)), gates) == 0
    through = path((0, 0, -2), (5.0, 1.1, -2.9), (6, 0, -2), (11, 0, -2))
    assert gates_passed(through, gates) == 2


def test_where_a_step_crosses_is_between_its_ends() -> None:
    askew = gate(0, 0, heading_rad=np.pi / 2)  # flown eastwards
    assert askew.crossing(*path((-3, -1, -2), (3, 1, -2))) is True
    assert askew.crossing(*path((-3, -1, -2), (1, 1, -2))) is True
    assert askew.crossing(*path((1, -1, -2), (3, 1, -2))) is False
    assert askew.crossing(*path((0, 1, -2), (0, -1, -2))) is None  # the wrong way
