"""Whether a trajectory has struck the frame of a gate; the physics knows of no gates."""

from dataclasses import dataclass

from sitl.course.course import BAR_M, DEPTH_M, Course, Gate, in_gate_axes
from sitl.rotation import Vec3

VEHICLE_RADIUS_M = 0.25
"""To the tips of the rotors; the vehicle is taken for a cube of twice this side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Crash:
    """The first thing that was hit hard; a flight ends with it."""

    t_s: float
    hit: str
    """"ground" or "gate N"."""
    speed_mps: float


def struck_gate(course: Course, start_ned_m: Vec3, end_ned_m: Vec3) -> int | None:
    """Index of the gate whose frame the straight way from one position to the other touches.

    The frame is the square ring between the opening and its outer edge, ``DEPTH_M`` deep, without
    the posts below it. Of several gates the first on the course is told.
    """
    for gate in course.gates:
        if _is_near(gate, start_ned_m, end_ned_m) and _strikes(gate, start_ned_m, end_ned_m):
            return gate.index
    return None


def _is_near(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> bool:
    """Cheap, and never wrong where it says no."""
    reach_m = gate.size_m / 2 + BAR_M + DEPTH_M + VEHICLE_RADIUS_M
    for start, end, center in zip(start_ned_m, end_ned_m, gate.center_ned_m, strict=True):
        if min(start, end) - center > 1.5 * reach_m or center - max(start, end) > 1.5 * reach_m:
            return False
    return True


def _strikes(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> bool:
    start, end = in_gate_axes(gate, start_ned_m), in_gate_axes(gate, end_ned_m)
    inner_m = gate.size_m / 2 - VEHICLE_RADIUS_M
    outer_m = gate.size_m / 2 + BAR_M + VEHICLE_RADIUS_M
    thick_m = DEPTH_M / 2 + VEHICLE_RADIUS_M
    bars = (
        ((-thick_m, inner_m, -outer_m), (thick_m, outer_m, outer_m)),
        ((-thick_m, -outer_m, -outer_m), (thick_m, -inner_m, outer_m)),
        ((-thick_m, -outer_m, inner_m), (thick_m, outer_m, outer_m)),
        ((-thick_m, -outer_m, -outer_m), (thick_m, outer_m, -inner_m)),
    )
    return any(_meets_box(start, end, low, high) for low, high in bars)


def _meets_box(start: Vec3, end: Vec3, low: Vec3, high: Vec3) -> bool:
    """Segment against an axis-aligned box (Kay and Kajiya's slabs); its surface belongs to it."""
    enter, leave = 0.0, 1.0
    for a, b, lowest, highest in zip(start, end, low, high, strict=True):
        if a == b:
            if not lowest <= a <= highest:
                return False
            continue
        first, last = sorted(((lowest - a) / (b - a), (highest - a) / (b - a)))
        enter, leave = max(enter, first), min(leave, last)
        if enter > leave:
            return False
    return True
