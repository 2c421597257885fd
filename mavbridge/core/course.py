"""Gates of a known course, and a path's progress through them."""

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import UserError
from mavbridge.core.records import Position
from policy.files import read_json


class CourseGate(NamedTuple):
    """Vertical square opening."""

    center_ned_m: Position
    yaw_rad: float
    """Heading of the passage: 0 = flown through northwards, + = clockwise."""
    size_m: float
    """Side of the opening."""

    @property
    def corners_ned_m(self) -> NDArray[np.float64]:
        """Corners of the opening [4, 3], clockwise from the upper left as flown through."""
        half_m = self.size_m / 2
        right = half_m * np.array([-math.sin(self.yaw_rad), math.cos(self.yaw_rad), 0.0])
        down = np.array([0.0, 0.0, half_m])
        corners_m = [-right - down, right - down, right + down, -right + down]
        return np.add(corners_m, self.center_ned_m)


class CourseProgress:
    """Counts the gates that a path passes in order, forward and inside the opening.

    A gate that was flown around remains the next one. ``sitl.course.GateCounter`` applies the same
    rule to the simulated vehicle's true path; a property test holds the two equal.
    """

    def __init__(self, gates: Sequence[CourseGate]) -> None:
        self._gates = tuple(gates)
        self._last: tuple[Position, int] | None = None
        self.passed_ns: list[int] = []

    @property
    def is_done(self) -> bool:
        """True if there are gates and all were passed."""
        return 0 < len(self._gates) == len(self.passed_ns)

    @property
    def speed_mps(self) -> float | None:
        """Mean speed along the straight legs from the first to the last gate passed; None before
        two."""
        passed_ns, passed = self.passed_ns, self._gates[: len(self.passed_ns)]
        if len(passed) < 2 or passed_ns[-1] == passed_ns[0]:
            return None
        legs_m = [math.dist(a.center_ned_m, b.center_ned_m) for a, b in pairwise(passed)]
        return sum(legs_m) * NS_PER_S / (passed_ns[-1] - passed_ns[0])

    def update(self, position: Position | None, at_ns: int) -> None:
        """Extend the path by a straight segment to ``position``; None interrupts it."""
        last = self._last
        if last is not None and position == last[0]:
            return  # told once more: it was there from the first time on
        self._last = None if position is None else (position, at_ns)
        if last is None or position is None:
            return
        start, start_ns = last
        reached = 0.0
        while len(self.passed_ns) < len(self._gates):
            fraction = _crossing(self._gates[len(self.passed_ns)], start, position)
            if fraction is None or fraction < reached:
                return
            reached = fraction
            self.passed_ns.append(start_ns + round(fraction * (at_ns - start_ns)))


def _crossing(gate: CourseGate, start: Position, end: Position) -> float | None:
    """Return the fraction of a segment at which it passes forward through the opening, or None."""
    (ahead_m, right_m, down_m), after = (_offset_m(gate, position) for position in (start, end))
    if not ahead_m < 0.0 <= after[0]:
        return None
    fraction = ahead_m / (ahead_m - after[0])
    right_m += fraction * (after[1] - right_m)
    down_m += fraction * (after[2] - down_m)
    half_m = gate.size_m / 2
    return fraction if abs(right_m) <= half_m and abs(down_m) <= half_m else None


def _offset_m(gate: CourseGate, position: Position) -> tuple[float, float, float]:
    """Return the position relative to the gate's centre: forward, right, down."""
    north_m, east_m, down_m = (a - b for a, b in zip(position, gate.center_ned_m, strict=True))
    cos_yaw, sin_yaw = math.cos(gate.yaw_rad), math.sin(gate.yaw_rad)
    return north_m * cos_yaw + east_m * sin_yaw, east_m * cos_yaw - north_m * sin_yaw, down_m


def read_gates(path: Path) -> tuple[CourseGate, ...]:
    """Read gates, in flight order, from JSON; raise UserError for another format.

    The format is that of ``python -m sitl course --json``: a list ``gates`` of objects with
    ``center_ned_m`` (north, east, down from the estimator's origin), ``yaw_rad`` and ``size_m``.
    """
    try:
        document: Any = read_json(path)
    except OSError as error:
        raise UserError(f"--gates {path}: {error.strerror}; name a JSON file of gates") from error
    except ValueError as error:
        raise UserError(f"--gates {path} is not JSON: {error}") from error
    try:
        return tuple(_gate(entry) for entry in document["gates"])
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"--gates {path} lists no gates ({error!r}): it needs a list `gates` of objects with "
            "center_ned_m, yaw_rad and size_m, as `python -m sitl course --json` prints it"
        ) from error


def _gate(entry: dict[str, Any]) -> CourseGate:
    north_m, east_m, down_m = (float(number) for number in entry["center_ned_m"])
    yaw_rad, size_m = float(entry["yaw_rad"]), float(entry["size_m"])
    if not all(map(math.isfinite, (north_m, east_m, down_m, yaw_rad))) or not 0 < size_m < 1e3:
        raise ValueError(f"a gate at {entry['center_ned_m']} of {size_m} m")
    return CourseGate(Position(north_m, east_m, down_m), yaw_rad, size_m)
