"""Gates that stand along a flight, where somebody knows them: for views and reports alone."""

import math
from pathlib import Path
from typing import Any, NamedTuple

from mavbridge.core.errors import UserError
from mavbridge.core.records import Position
from policy.files import read_json


class CourseGate(NamedTuple):
    """One vertical square opening."""

    center_ned_m: Position
    yaw_rad: float
    """Heading of the passage: 0 = flown through towards north, + = clockwise."""
    size_m: float
    """Side of the opening."""


def read_gates(path: Path) -> tuple[CourseGate, ...]:
    """Read gates in the order in which they are flown, from JSON.

    The file is that of ``python -m sitl course --json``: a list ``gates`` of objects that have
    ``center_ned_m`` (north, east, down from the estimator's origin), ``yaw_rad`` and ``size_m``.

    Raises:
        UserError: the file cannot be read, or is another one.
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
