"""Objects beside the path of a course: boxes, walls, poles, trees, and frames that are no gates.

They have no collision. Each is made of convex parts, which are painted from far to near.
"""

import cmath
import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sitl.course import BAR_M, OPENING_M, Course
from sitl.vehicle.conditions import Conditions, Draw, Hsv, Rgb

CLEARANCE_M = 3.0  # least distance of an object from the legs and from the gates' frames
BESIDE_M = 14.0  # largest distance from a leg, beyond the clearance
FRAME_M = math.sqrt(0.5) * OPENING_M + 2 * BAR_M  # from a gate's centre to beyond its corners
MATERIALS: tuple[Hsv, ...] = (
    ((0.0, 0.0, 0.1), (1.0, 1.0, 1.0)),  # any
    ((0.05, 0.0, 0.2), (0.4, 0.55, 0.8)),  # wood, stone
)
LEAVES: Hsv = ((0.12, 0.3, 0.15), (0.42, 0.8, 0.6))
RING = np.array([(0.0, math.cos(turn), math.sin(turn)) for turn in np.linspace(0, math.tau, 11)])
SQUARE = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
BOX_NORMALS = ((0, -1, 0), (1, 0, 0), (0, 1, 0), (-1, 0, 0), (0, 0, -1), (0, 0, 1))

FloatArray = NDArray[np.float64]


class Part(NamedTuple):
    """One convex or flat part of an object: quadrilaterals."""

    corners_m: FloatArray  # [N, 4, 3]: north, east, down, or axes of the object
    normals: FloatArray  # [N, 3] towards the visible side; zero = visible from both sides
    rgb: Rgb | FloatArray  # [3] or [N, 3], not lit


def clutter(course: Course, conditions: Conditions) -> list[Part]:
    """Return the parts of ``conditions.clutter`` objects a gate, without objects that would stand
    too close to the path."""
    draw = Draw(np.random.Generator(np.random.PCG64((conditions.seed, 9))))
    points = [0j, *(complex(*gate.center_ned_m[:2]) for gate in course.gates)]
    legs = [*pairwise(points), (points[-1], points[1])]  # the last: of a closed course
    parts: list[Part] = []
    for _ in range(round(conditions.clutter * len(course.gates))):
        shape = _shape(draw)
        reach_m = max(float(np.linalg.norm(p.corners_m[..., :2], axis=-1).max()) for p in shape)
        start, end = draw.one_of(legs[:-1])
        along = (end - start) / abs(end - start)
        aside_m = CLEARANCE_M + reach_m + BESIDE_M * draw.amount(1.0) ** 2
        at_m = start + draw.between(-0.1, 1.1) * (end - start)
        at_m += aside_m * along * draw.one_of((-1j, 1j))
        room_m = min(_distance_m(at_m, *leg) for leg in legs)
        gate_room_m = min(abs(at_m - point) for point in points[1:]) - FRAME_M
        heading = along * cmath.rect(1.0, draw.offset(1.0))
        x, y = heading.real, heading.imag
        turn, foot_m = np.array([[x, y, 0], [-y, x, 0], [0, 0, 1]]), (at_m.real, at_m.imag, 0.0)
        if min(room_m, gate_room_m) >= CLEARANCE_M + reach_m:
            parts += [Part(p.corners_m @ turn + foot_m, p.normals @ turn, p.rgb) for p in shape]
    return parts


def _distance_m(point: complex, start: complex, end: complex) -> float:
    """Return the distance of a point from a segment."""
    offset, along = point - start, end - start
    share = (offset * along.conjugate()).real / max(abs(along) ** 2, 1e-9)
    return abs(offset - min(1.0, max(0.0, share)) * along)


def _shape(draw: Draw) -> list[Part]:
    """Return an object at the origin that faces north.

    Two posts under a beam may look like a gate, but have no lower bar; a ring is smaller.
    """
    small_m, large_m, up_m = draw.between(0.04, 0.2), draw.between(0.4, 2.5), draw.between(1.5, 5.0)
    share = draw.amount(1.0)
    paint, other = (draw.colour(draw.one_of(MATERIALS)) for _ in range(2))
    match int(draw.random.integers(6)):
        case 0:  # box, wall
            deep_m = draw.one_of((0.1, large_m * share))
            return [_box(0.0, (deep_m, large_m), (0.0, draw.one_of((share, 1.0)) * up_m), paint)]
        case 1:  # pole, sign
            board = _box(0.0, (0.06, large_m / 2), (up_m, up_m + 0.15 + share), other)
            return [_box(0.0, (small_m, small_m), (0.0, up_m), paint), *draw.one_of(([], [board]))]
        case 2 | 3:  # posts, at the ends of a beam or further in
            middle_m = large_m * draw.one_of((1.0, 0.75)) - small_m
            return [
                *(_box(m, (small_m, small_m), (0.0, up_m), paint) for m in (-middle_m, middle_m)),
                _box(0.0, (small_m, large_m), (up_m, up_m + 2 * small_m), other),
            ]
        case 4:  # flat ring on a post
            outer_m = (0.3 + 0.35 * large_m) * RING
            inner_m = outer_m * (0.55 + 0.3 * share)
            corners_m = np.stack([outer_m[:-1], outer_m[1:], inner_m[1:], inner_m[:-1]], axis=1)
            ring = Part(corners_m - (0, 0, up_m), np.zeros((len(corners_m), 3)), paint)
            return [_box(0.0, (0.05, 0.05), (0.0, up_m - outer_m.max()), other), ring]
    crown_m, crown_up_m = 0.6 + 0.4 * large_m, (up_m / 2, up_m / 2 + 1.5 + 3 * share)
    crown = _box(0.0, (crown_m, crown_m), crown_up_m, draw.colour(LEAVES), draw.amount(1.0))
    return [_box(0.0, (small_m, small_m), (0.0, up_m / 2), (84, 62, 44)), crown]


def _box(
    right_m: float, half_m: tuple[float, float], up_m: tuple[float, float], rgb: Rgb, top: float = 1
) -> Part:
    """Return a box with half sizes forward and right; a square one may have a narrower top."""
    lower, upper = (
        np.column_stack((SQUARE * half_m * factor + (0.0, right_m), np.full(4, -height_m)))
        for factor, height_m in zip((1.0, top), up_m, strict=True)
    )
    around = [(lower[k], lower[k - 3], upper[k - 3], upper[k]) for k in range(4)]
    normals = np.array(BOX_NORMALS, dtype=float)
    normals[:4, 2] = (top - 1.0) * half_m[0] / (up_m[1] - up_m[0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Part(np.array([*around, upper, lower]), normals, rgb)
