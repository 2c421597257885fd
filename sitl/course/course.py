"""A gate course by seed, and the referee that counts the gates that were flown.

Frame: local NED in metres, origin at the start, the vehicle heads north. A gate is a vertical
square opening; ``yaw_rad`` is the heading in which it must be flown through (0 = north).
"""

import json
import math
from dataclasses import asdict, dataclass

import numpy as np

from sitl.errors import UsageError
from sitl.rotation import Quat, Vec3, wrap_pi

GATE_COUNT = 8
OPENING_M = 2.4
"""Side of the opening: five times the width of a 0.5 m quadrotor."""
BAR_M = 0.32
"""Width of the bars around an opening."""
DEPTH_M = 0.24
"""Of the frame, along the passage; the gate's centre is in the middle of it."""

# At 8 m/s the sharpest turn over the shortest leg, 35 degrees in 7 m, asks for v^2 * angle / leg =
# 5.6 m/s^2 = g * tan(30 deg), ArduCopter's default lean limit. The climb limit asks for 1.1 m/s.
FIRST_LEG_M = 8.0
LEG_M = (7.0, 12.0)
TURN_RAD = math.radians(35.0)
CLIMB_M = 1.0
FIRST_ALTITUDE_M = (2.0, 3.0)
ALTITUDE_M = (2.0, 4.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """One opening."""

    center_ned_m: Vec3
    yaw_rad: float
    """Heading of the passage, in [-pi, pi]."""
    size_m: float
    """Side of the square opening; the frame around it is not part of it."""
    index: int
    """Order on the course, from 0."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """Gates in the order in which they must be passed."""

    seed: int
    gates: tuple[Gate, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class GatePass:
    """A gate that was flown through, and when."""

    index: int
    t_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Start:
    """A state to begin a flight in, in the air."""

    position_ned_m: Vec3
    velocity_ned_mps: Vec3
    ned_from_body_wxyz: Quat
    next_gate: int
    """Gates are counted from this one."""


def make_course(seed: int) -> Course:
    """The course of this seed: the same on every machine.

    Legs turn by up to 35 degrees and rise or fall by up to 1 m; a gate faces the mean of the legs
    before and after it.

    Raises:
        UsageError: the seed is negative.
    """
    if seed < 0:
        raise UsageError(f"a course seed is a non-negative integer, got {seed}")
    random = np.random.Generator(np.random.PCG64(seed))
    turns_rad = random.uniform(-TURN_RAD, TURN_RAD, GATE_COUNT)
    legs_m = random.uniform(*LEG_M, GATE_COUNT)
    climbs_m = random.uniform(-CLIMB_M, CLIMB_M, GATE_COUNT)

    north_m = east_m = heading_rad = 0.0
    altitude_m = float(random.uniform(*FIRST_ALTITUDE_M))
    gates = []
    for index in range(GATE_COUNT):
        leg_m = FIRST_LEG_M if index == 0 else float(legs_m[index])
        north_m += leg_m * math.cos(heading_rad)
        east_m += leg_m * math.sin(heading_rad)
        if index > 0:
            altitude_m = float(np.clip(altitude_m + climbs_m[index], *ALTITUDE_M))
        turn_rad = float(turns_rad[index])
        gates.append(
            Gate(
                center_ned_m=(north_m, east_m, -altitude_m),
                yaw_rad=wrap_pi(heading_rad + turn_rad / 2),
                size_m=OPENING_M,
                index=index,
            )
        )
        heading_rad += turn_rad
    return Course(seed=seed, gates=tuple(gates))


def course_to_json(course: Course) -> str:
    """The course for people and other programs: frame, seed and gates in order."""
    return json.dumps(
        {
            "seed": course.seed,
            "frame": "local NED, metres; origin = start, which heads north; "
            "yaw_rad = heading of the passage; size_m = side of the square opening",
            "gates": [asdict(gate) for gate in course.gates],
        },
        indent=2,
    )


class GateCounter:
    """Watches a trajectory and counts gates: in order, in the right direction, inside the opening.

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
        """The next position will not have been reached by flying: a reboot."""
        self._previous = None

    def update(self, position_ned_m: Vec3, t_s: float) -> None:
        """Take the next position of the trajectory, which is straight since the last one."""
        previous, self._previous = self._previous, (position_ned_m, t_s)
        if previous is None:
            return
        start_ned_m, start_s = previous
        reached = 0.0
        while (index := self.next_gate) is not None:
            gate = self._gates[index]
            fraction = crossing(gate, start_ned_m, position_ned_m)
            if fraction is None or fraction < reached:
                return
            reached = fraction
            passed_s = start_s + fraction * (t_s - start_s)
            self.passed.append(GatePass(index=gate.index, t_s=passed_s))


def crossing(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> float | None:
    """Where on the segment, 0 to 1, it passes forward through the opening; None if it does not."""
    ahead_start_m, right_start_m, down_start_m = in_gate_axes(gate, start_ned_m)
    ahead_end_m, right_end_m, down_end_m = in_gate_axes(gate, end_ned_m)
    if not ahead_start_m < 0.0 <= ahead_end_m:
        return None
    fraction = ahead_start_m / (ahead_start_m - ahead_end_m)
    right_m = right_start_m + fraction * (right_end_m - right_start_m)
    down_m = down_start_m + fraction * (down_end_m - down_start_m)
    half_m = gate.size_m / 2
    return fraction if abs(right_m) <= half_m and abs(down_m) <= half_m else None


def in_gate_axes(gate: Gate, position_ned_m: Vec3) -> Vec3:
    """A position from the gate's centre, in its own axes: ahead along the passage, right, down."""
    north_m, east_m, down_m = (
        a - b for a, b in zip(position_ned_m, gate.center_ned_m, strict=True)
    )
    return turned_to_gate(gate, (north_m, east_m, down_m))


def turned_to_gate(gate: Gate, vector_ned: Vec3) -> Vec3:
    """A direction, velocity or offset in the gate's axes: ahead along the passage, right, down."""
    north, east, down = vector_ned
    cos_yaw, sin_yaw = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
    return (north * cos_yaw + east * sin_yaw, east * cos_yaw - north * sin_yaw, down)
