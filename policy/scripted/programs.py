"""Programs: the motion wanted at each time since the program began."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal, NamedTuple

TAKEOFF_ALTITUDE_M, DOUBLET_ALTITUDE_M = 3.0, 8.0
LEG_S, LEG_MPS = 4.0, 1.5
YAW_RATE_RADPS = math.radians(30.0)

Axis = Literal["roll", "pitch", "yaw", "climb"]
"""Motions that a doublet excites: to the right, forward, nose right, up."""


class Push(NamedTuple):
    """One output of the policy, held open-loop at a share of its full range."""

    axis: Axis
    share: float
    """In [-1, 1]; + is right, forward, nose right, up."""


class Motion(NamedTuple):
    """Motion that the program demands, in the horizontal frame that turns with the nose."""

    forward_mps: float = 0.0
    right_mps: float = 0.0
    yaw_rate_radps: float = 0.0
    push: Push | None = None
    """In place of the feedback on one axis."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DoubletStep:
    """One push to one side and then as long to the other, with the time in which it settles."""

    axis: Axis
    share: float
    begin_s: float
    """Since the program began."""
    half_s: float
    """Length of the push to each side."""
    settle_s: float

    @property
    def middle_s(self) -> float:
        """Moment at which the push changes sides."""
        return self.begin_s + self.half_s

    @property
    def end_s(self) -> float:
        """End of the push to the other side."""
        return self.begin_s + 2 * self.half_s


_PLAN: tuple[tuple[Axis, tuple[float, float], float, float], ...] = (
    # Leans end without a speed, a climb above where it began. Yaw and climb reach full range; a
    # lean does not, since it may be twice of what is expected.
    ("roll", (0.3, 0.6), 1.2, 3.0),
    ("pitch", (0.3, 0.6), 1.2, 3.0),
    ("yaw", (0.5, 1.0), 1.5, 2.0),
    ("climb", (0.6, 1.0), 2.0, 3.0),
)


def _doublet_steps() -> tuple[DoubletStep, ...]:
    planned = [(axis, share, half, rest) for axis, two, half, rest in _PLAN for share in two]
    begins = accumulate((2 * half + rest for _, _, half, rest in planned), initial=0.0)
    return tuple(
        DoubletStep(axis=axis, share=share, begin_s=begin_s, half_s=half_s, settle_s=settle_s)
        for (axis, share, half_s, settle_s), begin_s in zip(planned, begins, strict=False)
    )


DOUBLET_STEPS = _doublet_steps()
"""Each axis at two amplitudes, to both sides."""
DOUBLET_S = DOUBLET_STEPS[-1].end_s + DOUBLET_STEPS[-1].settle_s
"""After that time it begins again."""


def _doublet(time_s: float) -> Motion:
    time_s %= DOUBLET_S
    for step in DOUBLET_STEPS:
        if step.begin_s <= time_s < step.end_s:
            share = step.share if time_s < step.middle_s else -step.share
            return Motion(push=Push(step.axis, share))
    return Motion()


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """What is flown, and where."""

    motion: Callable[[float], Motion]
    """Of the seconds since the program began."""
    altitude_m: float = TAKEOFF_ALTITUDE_M
    """Above the start, where that is the ground."""


_LEGS = (Motion(LEG_MPS), Motion(0.0, LEG_MPS), Motion(-LEG_MPS), Motion(0.0, -LEG_MPS))
PROGRAMS: dict[str, Program] = {
    "hover": Program(motion=lambda _: Motion()),
    "square": Program(motion=lambda time_s: _LEGS[int(time_s / LEG_S) % len(_LEGS)]),
    "circle": Program(motion=lambda _: Motion(forward_mps=LEG_MPS, yaw_rate_radps=YAW_RATE_RADPS)),
    "yaw": Program(motion=lambda _: Motion(yaw_rate_radps=YAW_RATE_RADPS)),
    "doublet": Program(motion=_doublet, altitude_m=DOUBLET_ALTITUDE_M),
}
PROGRAM_NAMES = tuple(PROGRAMS)
