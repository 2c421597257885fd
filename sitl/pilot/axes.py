"""Which axis of a gamepad is which stick, and what its middle does not count."""

import re
from collections.abc import Sequence
from typing import NamedTuple

from sitl import UsageError
from sitl.expert.stick_response import StickPositions

DEAD_ZONE = 0.08
"""Share of the travel to each side that counts as centred; springs come back to within 0.05."""


class Axis(NamedTuple):
    """One axis, from 0, as the system numbers them; a pad's vertical ones are negative upwards."""

    number: int
    is_reversed: bool


class Axes(NamedTuple):
    """The axis of each stick."""

    throttle: Axis
    yaw: Axis
    pitch: Axis
    roll: Axis

    def sticks(self, values: Sequence[float]) -> StickPositions:
        """Positions of the sticks where the pad's axes have these values; an absent one is 0."""
        positions = []
        for axis in self:
            value = values[axis.number] if axis.number < len(values) else 0.0
            positions.append(past_dead_zone(-value if axis.is_reversed else value))
        return StickPositions(*positions)


DEFAULT_AXES = "throttle=-1,yaw=0,pitch=-4,roll=3"
"""Mode 2 on the usual pad: the left stick climbs and turns, the right one leans."""


def parse_axes(text: str) -> Axes:
    """Read ``throttle=-1,yaw=0,pitch=-4,roll=3``; a minus reverses the axis.

    Raises:
        UsageError: not the four sticks, each once, with the number of an axis.
    """
    found: dict[str, Axis] = {}
    for part in text.split(","):
        match = re.fullmatch(r"\s*(throttle|yaw|pitch|roll)=(-?)(\d{1,2})\s*", part)
        if match is None or match[1] in found:
            break
        found[match[1]] = Axis(int(match[3]), is_reversed=match[2] == "-")
    if len(found) != len(Axes._fields) or text.count(",") != len(found) - 1:
        raise UsageError(
            f"--pilot-axes {text}: give the axis of each stick, with a minus to reverse it, such "
            f"as {DEFAULT_AXES}"
        )
    return Axes(**found)


def past_dead_zone(value: float) -> float:
    """A position in [-1, 1] without its dead zone; full deflection stays full."""
    beyond = max(0.0, min(1.0, abs(value)) - DEAD_ZONE) / (1.0 - DEAD_ZONE)
    return beyond if value > 0.0 else -beyond
