"""Judges a trajectory: which gates it has passed, and whether it has struck the frame of one."""

from dataclasses import dataclass

from sitl.course.layout import BAR_M, DEPTH_M, Course, Gate
from sitl.rotation import Vec3

VEHICLE_RADIUS_M = 0.25
"""Distance to the rotor tips; the vehicle is treated as a cube of twice this side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GatePass:
    """A gate that was flown through, and when."""

    index: int
    t_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Crash:
    """The first hard impact; it ends the flight."""

    t_s: float
    hit: str  # "ground" or "gate N"
    speed_mps: float


class GateCounter:
    """Counts the gates that a trajectory passes: in order, forward, inside the opening.

    ``first`` is the gate to begin with, for a flight that starts in the middle of the course.
    A point on the very edge of the opening is inside. A gate that was flown around stays the next
    one until it has been passed.
    """

    def __init__(self, course: Course, *, first: int = 0) -> None:
        self._gates = course.gates
        self._first = first
        self._previous: tuple[Vec3, float] | None = None
        self.passed: list[GatePass] = []

    @property
    def next_gate(self) -> int | None:
        """Index of the gate to be passed next; None after the last."""
        index = self._first + len(self.passed)
        return index if index < len(self._gates) else None

    def interrupt(self) -> None:
        """Start a new trajectory: the next position was not reached by flying, after a reboot."""
        self._previous = None

    def update(self, position_ned_m: Vec3, t_s: float) -> None:
        """Append a position to the trajectory, which is straight since the previous one."""
        previous, self._previous = self._previous, (position_ned_m, t_s)
        if previous is None:
            return
        start_ned_m, start_s = previous
        reached = 0.0
        while (index := self.next_gate) is not None:
            fraction = crossing(self._gates[index], start_ned_m, position_ned_m)
            if fraction is None or fraction < reached:
                return
            reached = fraction
            self.passed.append(GatePass(index=index, t_s=start_s + fraction * (t_s - start_s)))


def crossing(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> float | None:
    """Fraction of the segment at which it passes forward through the opening, or None."""
    start_forward_m, start_right_m, start_down_m = gate.offset_m(start_ned_m)
    end_forward_m, end_right_m, end_down_m = gate.offset_m(end_ned_m)
    if not start_forward_m < 0.0 <= end_forward_m:
        return None
    fraction = start_forward_m / (start_forward_m - end_forward_m)
    right_m = start_right_m + fraction * (end_right_m - start_right_m)
    down_m = start_down_m + fraction * (end_down_m - start_down_m)
    half_m = gate.size_m / 2
    return fraction if abs(right_m) <= half_m and abs(down_m) <= half_m else None


def struck_gate(course: Course, start_ned_m: Vec3, end_ned_m: Vec3) -> int | None:
    """Index of the first gate whose frame the straight segment touches; None if it touches none.

    The frame is the square ring between the opening and its outer edge, ``DEPTH_M`` deep, without
    the posts below it; nothing stops the vehicle there, since the physics has no gates.
    """
    for gate in course.gates:
        if _is_near(gate, start_ned_m, end_ned_m) and _strikes(gate, start_ned_m, end_ned_m):
            return gate.index
    return None


def _is_near(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> bool:
    """Cheap test that never misses a gate that is struck."""
    reach_m = 1.5 * (gate.size_m / 2 + BAR_M + DEPTH_M + VEHICLE_RADIUS_M)
    for start, end, center in zip(start_ned_m, end_ned_m, gate.center_ned_m, strict=True):
        if min(start, end) - center > reach_m or center - max(start, end) > reach_m:
            return False
    return True


def _strikes(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> bool:
    start, end = gate.offset_m(start_ned_m), gate.offset_m(end_ned_m)
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
    """Segment against a closed axis-aligned box (slab method of Kay and Kajiya, 1986)."""
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
