import math
from itertools import pairwise

import numpy as np
import pytest

from sitl.camera.clutter import CLEARANCE_M, clutter
from sitl.course import BAR_M, RACE_SEEDS, make_course
from sitl.vehicle.conditions import Conditions

CROWDED = Conditions(clutter=6.0)


def points_between(first, second, count=9):
    return np.linspace(first, second, count)


def plan_points_m(part):
    """Points [N, 2] on the edges of a part's faces, seen from above."""
    corners_m = part.corners_m[..., :2]
    return points_between(corners_m, np.roll(corners_m, -1, axis=1)).reshape(-1, 2)


@pytest.mark.parametrize("seed", [0, 1, 2, 3, 4, 5, RACE_SEEDS, RACE_SEEDS + 1])
def test_objects_stand_clear_of_the_path_and_of_the_gates(seed):
    course = make_course(seed)
    corners = [(0.0, 0.0), *(gate.center_ned_m[:2] for gate in course.gates)]
    path_m = np.concatenate([points_between(*leg, count=60) for leg in pairwise(corners)])
    frames_m = []
    for gate in course.gates:
        half_m = gate.size_m / 2 + 1.3 * BAR_M
        aside_m = half_m * np.array((-math.sin(gate.yaw_rad), math.cos(gate.yaw_rad)))
        frames_m += [gate.center_ned_m[:2] - aside_m, gate.center_ned_m[:2] + aside_m]
    clear_m = np.concatenate([path_m, frames_m])
    parts = clutter(course, CROWDED)
    assert len(parts) > 30
    for part in parts:
        apart_m = np.linalg.norm(plan_points_m(part)[:, None] - clear_m, axis=-1)
        assert apart_m.min() >= CLEARANCE_M
        assert part.corners_m[..., 2].max() <= 1e-9  # above the ground


def test_normals_point_out_of_a_part():
    for part in clutter(make_course(3), CROWDED):
        outward = part.corners_m.mean(axis=1) - part.corners_m.mean(axis=(0, 1))
        if part.normals.any():  # else flat, and visible from both sides
            assert (np.einsum("nk,nk->n", outward, part.normals) > 0).all()
            edges = part.corners_m - np.roll(part.corners_m, 1, axis=1)
            assert np.abs(np.einsum("nik,nk->ni", edges, part.normals)).max() < 1e-9
