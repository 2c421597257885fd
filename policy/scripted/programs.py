"""Programs: the motion wanted at each time since the program began."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import accumulate
from typing import Literal, NamedTuple

from policy.contract import ActionKind
from policy.errors import PolicyError

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
    """One axis pushed to one side, then as far and as long to the other."""

    axis: Axis
    share: float
    begin_s: float
    """Since the program began."""
    half_s: float
    """Length of the push to each side."""
    rest_s: float
    """Between the two, with a push of nothing."""
    settle_s: float
    """After them, with feedback."""

    @property
    def back_s(self) -> float:
        """Begin of the push to the other side."""
        return self.begin_s + self.half_s + self.rest_s

    @property
    def end_s(self) -> float:
        """End of the push to the other side."""
        return self.back_s + self.half_s

    def push_at(self, time_s: float) -> Push | None:
        """The push at a time since the program began; None while it settles, and at other steps."""
        if not self.begin_s <= time_s < self.end_s:
            return None
        if time_s >= self.back_s:
            return Push(self.axis, -self.share)
        return Push(self.axis, self.share if time_s < self.begin_s + self.half_s else 0.0)


class _Plan(NamedTuple):
    axis: Axis
    shares: tuple[float, float]
    half_s: float
    rest_s: float
    settle_s: float


# A lean leaves no speed behind, a climb no height. Yaw and climb reach full range; a lean does not,
# since it may be twice of what is expected. All but a lean also wait until an overshoot is over.
_LEANS = (_Plan("roll", (0.3, 0.6), 1.2, 0.0, 3.0), _Plan("pitch", (0.3, 0.6), 1.2, 0.0, 3.0))
_SPEEDS = (_Plan("roll", (0.3, 0.6), 3.0, 0.0, 3.0), _Plan("pitch", (0.3, 0.6), 3.0, 0.0, 3.0))
_YAW = _Plan("yaw", (0.5, 1.0), 3.0, 2.0, 3.5)
_CLIMB = _Plan("climb", (0.6, 1.0), 3.2, 1.7, 3.5)
_PLANS: dict[ActionKind, tuple[_Plan, ...]] = {
    "sticks": (*_LEANS, _YAW, _CLIMB),
    "attitude": (*_LEANS, _YAW),
    "rates": (*_LEANS, _YAW),
    "velocity": (*_SPEEDS, _YAW, _CLIMB),
}


def doublet_steps(action: ActionKind) -> tuple[DoubletStep, ...]:
    """Each axis that a kind of action can push, at two amplitudes, to both sides.

    Thrust has no gain to be found: it is balanced by the height, and only its mean is told.
    """
    planned = [(plan, share) for plan in _PLANS[action] for share in plan.shares]
    lengths = (2 * plan.half_s + plan.rest_s + plan.settle_s for plan, _ in planned)
    begins = accumulate(lengths, initial=0.0)
    return tuple(
        DoubletStep(
            axis=plan.axis,
            share=share,
            begin_s=begin_s,
            half_s=plan.half_s,
            rest_s=plan.rest_s,
            settle_s=plan.settle_s,
        )
        for (plan, share), begin_s in zip(planned, begins, strict=False)
    )


def doublet_length_s(action: ActionKind) -> float:
    """Time after which the doublet begins again."""
    last = doublet_steps(action)[-1]
    return last.end_s + last.settle_s


def _doublet(action: ActionKind) -> Callable[[float], Motion]:
    steps, length_s = doublet_steps(action), doublet_length_s(action)

    def motion(time_s: float) -> Motion:
        pushes = (step.push_at(time_s % length_s) for step in steps)
        return Motion(push=next(filter(None, pushes), None))

    return motion


@dataclass(frozen=True, slots=True, kw_only=True)
class Program:
    """What is flown, and where."""

    motion: Callable[[float], Motion]
    """Motion by the seconds since the program began."""
    altitude_m: float = TAKEOFF_ALTITUDE_M
    """Above the start, where that is the ground."""


_LEGS = (Motion(LEG_MPS), Motion(0.0, LEG_MPS), Motion(-LEG_MPS), Motion(0.0, -LEG_MPS))
_MOTIONS: dict[str, Callable[[float], Motion]] = {
    "hover": lambda _: Motion(),
    "square": lambda time_s: _LEGS[int(time_s / LEG_S) % len(_LEGS)],
    "circle": lambda _: Motion(forward_mps=LEG_MPS, yaw_rate_radps=YAW_RATE_RADPS),
    "yaw": lambda _: Motion(yaw_rate_radps=YAW_RATE_RADPS),
}
DOUBLET = "doublet"
PROGRAM_NAMES = (*_MOTIONS, DOUBLET)


def make_program(name: str, action: ActionKind) -> Program:
    """A program of ``PROGRAM_NAMES`` for a policy that puts out this kind of action."""
    if name == DOUBLET:
        return Program(motion=_doublet(action), altitude_m=DOUBLET_ALTITUDE_M)
    if name not in _MOTIONS:
        raise PolicyError(f"scripted program {name!r} is unknown; use one of {list(PROGRAM_NAMES)}")
    return Program(motion=_MOTIONS[name])
