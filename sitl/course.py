"""Gate courses generated from a seed, passage and crash detection, and ground truth.

Frame: local NED in metres, origin at the start, the vehicle heads north. A gate is a vertical
square opening; ``yaw_rad`` is the heading in which it must be flown through (0 = north).
"""

import cmath
import json
import math
from collections.abc import Iterable
from dataclasses import asdict, dataclass

import numpy as np

from sitl import UsageError
from sitl.vehicle.rotation import (
    IDENTITY,
    Quat,
    Vec3,
    conjugate,
    horizontal,
    minus,
    plus,
    rotate,
    wrap_pi,
    yaw_of,
)

OPENING_M = 2.4  # side of the opening: five times the width of a 0.5 m quadrotor
BAR_M = 0.32  # width of the bars around an opening
DEPTH_M = 0.24  # depth of the frame along the passage; the gate's centre is halfway in
RACE_SEEDS = 1_000_000_000  # seeds from here on give race courses, smaller ones easy courses
LOOP_SEEDS = 2_000_000_000  # seeds from here on give loops
LOOP_GATES = 8
LOOP_FIRST_LEG_M = 6.0
LOOP_RADIUS_M = (13.5, 16.5)  # distance of a loop's gates from its middle; legs of 8 to 15 m
LOOP_TURN_RAD = math.radians(5.0)  # largest shift of a gate along the loop, to either side
LOOP_ALTITUDE_M = (2.2, 3.4)


@dataclass(frozen=True, slots=True, kw_only=True)
class Family:
    """Limits of one kind of course; pairs are (least, most)."""

    gate_count: int
    first_leg_m: float
    leg_m: tuple[float, float]
    turn_rad: float  # largest turn between legs, to either side
    climb_m: float  # largest height change between gates, up or down
    first_altitude_m: tuple[float, float]
    altitude_m: tuple[float, float]


# At 8 m/s the sharpest turn over the shortest leg, 35 degrees in 7 m, needs v^2 * angle / leg = 5.6
# m/s^2 = g * tan(30 deg), ArduCopter's default lean limit. The climb limit needs 1.1 m/s.
EASY = Family(
    gate_count=8,
    first_leg_m=8.0,
    leg_m=(7.0, 12.0),
    turn_rad=math.radians(35.0),
    climb_m=1.0,
    first_altitude_m=(2.0, 3.0),
    altitude_m=(2.0, 4.0),
)
# At 10 m/s the sharpest turn, 50 degrees in 10 m, needs 8.7 m/s^2: a lean of 42 degrees. The
# steepest climb or dive, 3 m in 10 m, adds velocity changes of 3 m/s within a second.
RACE = Family(
    gate_count=12,
    first_leg_m=12.0,
    leg_m=(10.0, 16.0),
    turn_rad=math.radians(50.0),
    climb_m=3.0,
    first_altitude_m=(2.5, 3.5),
    altitude_m=(2.0, 8.0),
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Gate:
    """One gate of a course."""

    center_ned_m: Vec3
    yaw_rad: float  # heading of the passage, in [-pi, pi]
    size_m: float  # side of the square opening, without the frame
    index: int  # position on the course, from 0

    def to_axes(self, vector_ned: Vec3) -> Vec3:
        """Rotate a NED direction, velocity or offset into gate axes: forward, right, down."""
        level = horizontal(vector_ned) * cmath.rect(1.0, -self.yaw_rad)
        return level.real, level.imag, vector_ned[2]

    def offset_m(self, position_ned_m: Vec3) -> Vec3:
        """Return the position relative to the gate's centre in gate axes: forward, right, down."""
        return self.to_axes(minus(position_ned_m, self.center_ned_m))


@dataclass(frozen=True, slots=True, kw_only=True)
class Course:
    """Gates in the order in which they must be passed."""

    seed: int
    gates: tuple[Gate, ...]
    laps: int = 1
    is_loop: bool = False  # the first gate comes after the last

    @property
    def passages(self) -> int:
        """Number of gates to pass, in all laps."""
        return self.laps * len(self.gates)

    def ahead(self, passed: int, count: int) -> tuple[Gate, ...]:
        """Return up to ``count`` gates that come after ``passed`` passages; a loop never ends."""
        if not self.is_loop:
            return self.gates[passed : passed + count]
        return tuple(self.gates[k % len(self.gates)] for k in range(passed, passed + count))


@dataclass(frozen=True, slots=True, kw_only=True)
class AirborneStart:
    """Initial state of a flight that begins in the air; by default a hover, facing north."""

    position_ned_m: Vec3
    velocity_ned_mps: Vec3 = (0.0, 0.0, 0.0)
    ned_from_body_wxyz: Quat = IDENTITY
    next_gate: int = 0  # index of the first gate to pass


def make_course(seed: int, laps: int = 1) -> Course:
    """Generate the course of this seed; it is the same on every machine.

    Below ``RACE_SEEDS``, legs turn by up to 35 degrees and rise or fall by up to 1 m; from there
    on, by up to 50 degrees and 3 m. From ``LOOP_SEEDS`` on, eight gates stand around a circle and
    are flown ``laps`` times. A gate faces the mean of the legs before and after it.

    Raises:
        UsageError: the course is no loop and has several laps.
    """
    if seed >= LOOP_SEEDS:
        return _make_loop(seed, laps)
    if laps != 1:
        raise UsageError(f"only a loop, from seed {LOOP_SEEDS} on, has laps: got {laps} of {seed}")
    family = EASY if seed < RACE_SEEDS else RACE
    random = np.random.Generator(np.random.PCG64(seed))
    turns_rad = random.uniform(-family.turn_rad, family.turn_rad, family.gate_count)
    legs_m = random.uniform(*family.leg_m, family.gate_count)
    climbs_m = random.uniform(-family.climb_m, family.climb_m, family.gate_count)

    at_m, heading_rad = 0j, 0.0
    altitude_m = float(random.uniform(*family.first_altitude_m))
    places: list[tuple[complex, float, float]] = []
    for index, turn_rad in enumerate(turns_rad.tolist()):
        at_m += cmath.rect(float(legs_m[index]) if index else family.first_leg_m, heading_rad)
        if index > 0:
            altitude_m = float(np.clip(altitude_m + climbs_m[index], *family.altitude_m))
        places.append((at_m, altitude_m, heading_rad + turn_rad / 2))
        heading_rad += turn_rad
    return Course(seed=seed, gates=_gates(places))


def _make_loop(seed: int, laps: int) -> Course:
    """Return a loop, flown clockwise or the other way round, that passes over the start."""
    random = np.random.Generator(np.random.PCG64(seed))
    radius_m = random.uniform(*LOOP_RADIUS_M, LOOP_GATES)
    shift_rad = random.uniform(-LOOP_TURN_RAD, LOOP_TURN_RAD, LOOP_GATES)
    altitude_m = random.uniform(*LOOP_ALTITUDE_M, LOOP_GATES).tolist()
    side = 1 if random.random() < 0.5 else -1
    angle_rad = side * (np.arange(LOOP_GATES) * math.tau / LOOP_GATES + shift_rad)
    points = [cmath.rect(r, a) for r, a in zip(radius_m.tolist(), angle_rad.tolist(), strict=True)]
    in_rad = [cmath.phase(point - points[k - 1]) for k, point in enumerate(points)]
    out_rad = [*in_rad[1:], in_rad[0]]
    through_rad = [out - wrap_pi(out - come) / 2 for come, out in zip(in_rad, out_rad, strict=True)]
    # The first gate stands north of the start and is flown northwards.
    turn = cmath.rect(1.0, -through_rad[0])
    at_m = [(point - points[0]) * turn + LOOP_FIRST_LEG_M for point in points]
    yaw_rad = [through - through_rad[0] for through in through_rad]
    gates = _gates(zip(at_m, altitude_m, yaw_rad, strict=True))
    return Course(seed=seed, gates=gates, laps=laps, is_loop=True)


def _gates(places: Iterable[tuple[complex, float, float]]) -> tuple[Gate, ...]:
    """Return gates at north + 1j * east, height [m] and heading [rad]."""
    return tuple(
        Gate(
            center_ned_m=(at_m.real, at_m.imag, -altitude_m),
            yaw_rad=wrap_pi(yaw_rad),
            size_m=OPENING_M,
            index=index,
        )
        for index, (at_m, altitude_m, yaw_rad) in enumerate(places)
    )


def course_to_json(course: Course) -> str:
    """Return the course as JSON: seed, frame and gates in order, those of each lap."""
    return json.dumps(
        {
            "seed": course.seed,
            "frame": "local NED, metres; origin = start, which heads north; "
            "yaw_rad = heading of the passage; size_m = side of the square opening",
            "gates": [asdict(gate) for gate in course.ahead(0, course.passages)],
        },
        indent=2,
    )


@dataclass(frozen=True, slots=True, kw_only=True)
class GateTruth:
    """The next two gates relative to one pose; None past the end of the course."""

    next_gate: int | None = None  # passages before the next gate
    gate_body_m: Vec3 | None = None  # centre of the next gate in FRD body axes
    gate_yaw_rad: float | None = None  # heading of its passage minus the body's, in [-pi, pi]
    gate_after_body_m: Vec3 | None = None  # centre of the gate after it, in FRD body axes


def gate_truth(
    course: Course, next_gate: int | None, position_ned_m: Vec3, ned_from_body_wxyz: Quat
) -> GateTruth:
    """Return the ground truth at a pose for ``next_gate`` and the gate after it."""
    if next_gate is None:
        return GateTruth()
    body_from_ned = conjugate(ned_from_body_wxyz)
    ahead = course.ahead(next_gate, 2)
    centers_body_m = [
        rotate(body_from_ned, minus(gate.center_ned_m, position_ned_m)) for gate in ahead
    ]
    return GateTruth(
        next_gate=next_gate,
        gate_body_m=centers_body_m[0],
        gate_yaw_rad=wrap_pi(ahead[0].yaw_rad - yaw_of(ned_from_body_wxyz)),
        gate_after_body_m=centers_body_m[1] if len(centers_body_m) > 1 else None,
    )


VEHICLE_RADIUS_M = 0.25
"""Distance from the centre to the rotor tips; the vehicle counts as a cube of twice this side."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GatePass:
    """Passage of one gate and its time."""

    index: int
    t_s: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Crash:
    """The first hard impact; it ends the flight."""

    t_s: float
    hit: str  # "ground" or "gate N"
    speed_mps: float


class GateCounter:
    """Counts the gates that a trajectory passes in order, forward and inside the opening.

    ``first`` is the gate to begin with, for a flight that starts in the middle of the course. The
    edge of the opening is inside. A gate that was flown around stays next until it is passed.
    """

    def __init__(self, course: Course, *, first: int = 0) -> None:
        self._course = course
        self._first = first
        self.position_ned_m: Vec3 | None = None  # the last one
        self._last_s = 0.0
        self.passed: list[GatePass] = []

    @property
    def next_gate(self) -> int | None:
        """Number of passages before the next gate; None after the last."""
        index = self._first + len(self.passed)
        return index if index < self._course.passages else None

    def interrupt(self) -> None:
        """Start a new trajectory after a jump in position, for example a reboot."""
        self.position_ned_m = None

    def update(self, position_ned_m: Vec3, t_s: float) -> None:
        """Append a position; the path from the previous one counts as a straight line."""
        start_ned_m, self.position_ned_m = self.position_ned_m, position_ned_m
        start_s, self._last_s = self._last_s, t_s
        if start_ned_m is None:
            return
        reached = 0.0
        while (index := self.next_gate) is not None:
            gates = self._course.gates
            fraction = crossing(gates[index % len(gates)], start_ned_m, position_ned_m)
            if fraction is None or fraction < reached:
                return
            reached = fraction
            self.passed.append(GatePass(index=index, t_s=start_s + fraction * (t_s - start_s)))


def crossing(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> float | None:
    """Return the fraction of the segment at which it passes forward through the opening, if any."""
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
    """Return the index of the first gate whose frame the straight segment touches, or None.

    The frame is the square ring between the opening and its outer edge, ``DEPTH_M`` deep, without
    the posts below it. Nothing stops the vehicle there, since the physics has no gates.
    """
    for gate in course.gates:
        if _is_near(gate, start_ned_m, end_ned_m) and _strikes(gate, start_ned_m, end_ned_m):
            return gate.index
    return None


def _is_near(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> bool:
    """True if the gate may be struck; a cheap check without false negatives."""
    reach_m = 1.5 * (gate.size_m / 2 + BAR_M + DEPTH_M + VEHICLE_RADIUS_M)
    for start, end, center in zip(start_ned_m, end_ned_m, gate.center_ned_m, strict=True):
        if min(start, end) - center > reach_m or center - max(start, end) > reach_m:
            return False
    return True


def _strikes(gate: Gate, start_ned_m: Vec3, end_ned_m: Vec3) -> bool:
    """True if the segment meets the frame, grown by the vehicle's radius.

    Within the frame's outer box (slab method of Kay and Kajiya, 1986), the larger distance from the
    passage's axis is greatest where the segment enters or leaves.
    """
    start, end = gate.offset_m(start_ned_m), gate.offset_m(end_ned_m)
    outer_m = gate.size_m / 2 + BAR_M + VEHICLE_RADIUS_M
    enter, leave = 0.0, 1.0
    reaches_m = (DEPTH_M / 2 + VEHICLE_RADIUS_M, outer_m, outer_m)
    for a, b, reach_m in zip(start, end, reaches_m, strict=True):
        if a == b and abs(a) > reach_m:
            return False
        if a != b:
            first, last = sorted(((-reach_m - a) / (b - a), (reach_m - a) / (b - a)))
            enter, leave = max(enter, first), min(leave, last)
    at_ends = (plus(start, minus(end, start), share) for share in (enter, leave))
    inner_m = gate.size_m / 2 - VEHICLE_RADIUS_M
    return enter <= leave and any(
        max(abs(right), abs(down)) >= inner_m for _, right, down in at_ends
    )
