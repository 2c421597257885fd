"""Programs (the demanded motion over time), and the feedback that turns a motion into an action.

Sticks are for an autopilot that holds altitude at mid-stick (ArduPilot ALT_HOLD, PX4 ALTCTL): the
throttle stick is a climb rate, pitch and roll are lean angles, yaw is a yaw rate. All values are in
NED and FRD, velocities in the horizontal frame that turns with the nose.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple, TypeAlias

from policy.contract import QUATERNION, RATE, VELOCITY, ActionKind, Contract, FloatArray
from policy.errors import PolicyError
from policy.motion.stick_loop import GRAVITY_MPS2

TAKEOFF_ALTITUDE_M, DOUBLET_ALTITUDE_M = 3.0, 8.0
LEG_S, LEG_MPS = 4.0, 1.5
YAW_RATE_RADPS = math.radians(30.0)

Axis = Literal["roll", "pitch", "yaw", "climb"]
"""Axes of a doublet: right, forward, nose right, up."""


class Push(NamedTuple):
    """Push of one output to a share of its full range, open loop."""

    axis: Axis
    share: float
    """In [-1, 1]; + is right, forward, nose right, up."""


class Motion(NamedTuple):
    """Motion that the program demands, in the horizontal frame that turns with the nose."""

    forward_mps: float = 0.0
    right_mps: float = 0.0
    yaw_rate_radps: float = 0.0
    push: Push | None = None
    """Replaces the feedback on one axis."""


class DoubletStep(NamedTuple):
    """Doublet on one axis: a push to one side, then an equal one to the other side."""

    axis: Axis
    share: float
    half_s: float
    """Length of the push to each side."""
    rest_s: float
    """Pause between the two pushes, with a push of 0."""
    settle_s: float
    """Time with feedback after the pushes."""
    begin_s: float = 0.0
    """Start of the push to the first side."""

    @property
    def back_s(self) -> float:
        """Start of the push to the other side."""
        return self.begin_s + self.half_s + self.rest_s

    @property
    def end_s(self) -> float:
        """End of the push to the other side."""
        return self.back_s + self.half_s

    def push_at(self, time_s: float) -> Push | None:
        """Return the push at a time; None outside of this doublet."""
        if not self.begin_s <= time_s < self.end_s:
            return None
        if time_s >= self.back_s:
            return Push(self.axis, -self.share)
        return Push(self.axis, self.share if time_s < self.begin_s + self.half_s else 0.0)


# Each doublet ends without net speed or height. Yaw and climb reach full range; leans do not, since
# they may be twice as large as expected. All but leans also wait until an overshoot is over.
_ROLL = DoubletStep("roll", 0.6, 1.2, 0.0, 3.0)
_PITCH = _ROLL._replace(axis="pitch")
_YAW, _CLIMB = DoubletStep("yaw", 1.0, 3.0, 2.0, 3.5), DoubletStep("climb", 1.0, 3.2, 1.7, 3.5)
_STEPS: dict[ActionKind, tuple[DoubletStep, ...]] = {
    "sticks": (_ROLL, _PITCH, _YAW, _CLIMB),
    "attitude": (_ROLL, _PITCH, _YAW),
    "rates": (_ROLL, _PITCH, _YAW),
    "velocity": (_ROLL._replace(half_s=3.0), _PITCH._replace(half_s=3.0), _YAW, _CLIMB),
}


def doublet_steps(action: ActionKind, begin_s: float = 0.0) -> tuple[DoubletStep, ...]:
    """Return the doublets of an action kind, one for each axis, if the program begins at a time.

    Thrust has no gain to identify: the height balances it, and only its mean is reported.
    """
    steps: list[DoubletStep] = []
    for step in _STEPS[action]:
        steps.append(step._replace(begin_s=begin_s))
        begin_s = steps[-1].end_s + step.settle_s
    return tuple(steps)


def doublet_length_s(action: ActionKind) -> float:
    """Return the time after which the doublets repeat."""
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
    """Motion to fly, and its altitude."""

    motion: Callable[[float], Motion]
    """Motion by the seconds since the program began."""
    altitude_m: float = TAKEOFF_ALTITUDE_M
    """Altitude above the start, if the flight starts on the ground."""


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
    """Return a program of ``PROGRAM_NAMES`` for a policy that puts out this kind of action."""
    if name == DOUBLET:
        return Program(motion=_doublet(action), altitude_m=DOUBLET_ALTITUDE_M)
    if name not in _MOTIONS:
        raise PolicyError(f"scripted program {name!r} is unknown; use one of {list(PROGRAM_NAMES)}")
    return Program(motion=_MOTIONS[name])


Four: TypeAlias = tuple[float, float, float, float]

FULL_LEAN_RAD = math.radians(Contract.full_lean_deg)
FULL_LEAN_ACCEL_MPS2 = GRAVITY_MPS2 * math.tan(FULL_LEAN_RAD)

CLIMB_RATE_GAIN = 0.5  # m/s of command per m/s of climb-rate error
LEAN_PER_MPS = 0.3  # share of full lean per m/s: closes in 0.6 s, slower than a lean builds up
LEAN_PER_WANTED_MPS = 0.04  # against drag
YAW_RATE_GAIN = 0.3
MAX_LEAN = 0.6
"""Largest lean of the feedback, as a share of the full lean."""
RATE_PER_LEAN = 4.0  # rad/s per rad of lean error
MAX_LEAN_RATE_RADPS = 1.5

ACCEL_PER_CLIMB = 2.5  # m/s^2 per m/s of climb-rate error
ACCEL_INTEGRAL = 0.8  # m/s^3 per m/s of climb-rate error
MAX_INTEGRAL_MPS2 = 3.5
"""Covers a vehicle whose hover thrust is a third above or below the contract's."""
LEAST_THRUST, MOST_THRUST = 0.1, 0.85

_FULL_YAW_PUSH = math.radians(90.0)
_FULL_PUSHES: dict[ActionKind, dict[Axis, float]] = {
    "sticks": {"climb": 1.0, "yaw": 1.0, "pitch": 1.0, "roll": 1.0},
    "velocity": {"climb": 1.5, "yaw": _FULL_YAW_PUSH, "pitch": 4.0, "roll": 4.0},
    "attitude": {"yaw": _FULL_YAW_PUSH, "pitch": 1.0, "roll": 1.0},
}
"""Full range of a push on each axis: of sticks, m/s, rad/s, or ``FULL_LEAN_RAD``."""


class Measured(NamedTuple):
    """Motion of the vehicle."""

    forward_mps: float
    right_mps: float
    climb_mps: float
    yaw_rate_radps: float
    roll_rad: float
    pitch_rad: float


class Climb(NamedTuple):
    """Demand of the altitude loop."""

    wanted_mps: float
    is_held: bool
    """True at the right height: an autopilot that holds it needs no stick."""
    thrust: float
    """Collective thrust for the demand, in [0, 1]."""


def measure(state: FloatArray) -> Measured:
    """Return the motion in a 13-D state in ``ned_frd``."""
    north, east, down = (float(v) for v in state[VELOCITY])
    w, x, y, z = (float(q) for q in state[QUATERNION])
    # Yaw, roll and pitch of the Z-Y-X Euler angles of a unit quaternion.
    heading = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    cos, sin = math.cos(heading), math.sin(heading)
    return Measured(
        forward_mps=cos * north + sin * east,
        right_mps=cos * east - sin * north,
        climb_mps=-down,
        yaw_rate_radps=float(state[RATE][2]),
        roll_rad=math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        pitch_rad=math.asin(clip(2 * (w * y - z * x), 1.0)),
    )


def clip(value: float, limit: float) -> float:
    """Clip the value to +-limit."""
    return max(-limit, min(limit, value))


class ThrustLoop:
    """Collective thrust for a climb rate; learns the hover thrust in flight."""

    def __init__(self, hover_thrust: float) -> None:
        self._hover_thrust = hover_thrust
        self._integral_mps2 = 0.0

    def reset(self) -> None:
        """Restart at the contract's hover thrust."""
        self._integral_mps2 = 0.0

    def update(self, error_mps: float, step_s: float, *, is_airborne: bool) -> float:
        """Return the thrust for a climb rate that is ``error_mps`` below the demand."""
        if is_airborne:  # on the ground it would wind up
            integral = self._integral_mps2 + ACCEL_INTEGRAL * error_mps * step_s
            self._integral_mps2 = clip(integral, MAX_INTEGRAL_MPS2)
        accel_mps2 = ACCEL_PER_CLIMB * error_mps + self._integral_mps2
        thrust = self._hover_thrust * (1.0 + accel_mps2 / GRAVITY_MPS2)
        return max(LEAST_THRUST, min(MOST_THRUST, thrust))


def _pushed(kind: ActionKind, wanted: Motion, outputs: dict[Axis, float]) -> dict[Axis, float]:
    """Return the outputs by axis; the program's push replaces the feedback on its axis."""
    if (push := wanted.push) is None or push.axis not in _FULL_PUSHES[kind]:
        return outputs
    return outputs | {push.axis: push.share * _FULL_PUSHES[kind][push.axis]}


def sticks(wanted: Motion, measured: Measured, climb: Climb) -> Four:
    """Return throttle, yaw, pitch, roll: +pitch leans forward, +roll leans right."""
    pitch, roll = _leans(wanted, measured)
    yaw = clip(_yaw_rate(wanted, measured) / math.radians(Contract.full_yaw_rate_degps), 1.0)
    throttle = _throttle(measured, climb)
    out = _pushed("sticks", wanted, {"climb": throttle, "yaw": yaw, "pitch": pitch, "roll": roll})
    return out["climb"], out["yaw"], out["pitch"], out["roll"]


def _throttle(measured: Measured, climb: Climb) -> float:
    if climb.is_held:
        return 0.0
    command = climb.wanted_mps + CLIMB_RATE_GAIN * (climb.wanted_mps - measured.climb_mps)
    dead_zone = Contract.throttle_dead_zone
    beyond = (1 - dead_zone) * command / Contract.full_climb_mps
    return clip(math.copysign(dead_zone, command) + beyond, 1.0)


def velocity(wanted: Motion, measured: Measured, climb: Climb) -> Four:
    """Return forward, right, down in m/s, and the yaw rate: the autopilot closes the loop."""
    own: dict[Axis, float] = {"pitch": wanted.forward_mps, "roll": wanted.right_mps}
    out = _pushed(
        "velocity", wanted, own | {"climb": climb.wanted_mps, "yaw": wanted.yaw_rate_radps}
    )
    return out["pitch"], out["roll"], -out["climb"], out["yaw"]


def attitude(wanted: Motion, measured: Measured, climb: Climb) -> Four:
    """Return thrust, roll, pitch (+ nose up) and yaw rate."""
    forward, right = _leans(wanted, measured)
    own: dict[Axis, float] = {"pitch": forward, "roll": right}
    out = _pushed("attitude", wanted, own | {"yaw": _yaw_rate(wanted, measured)})
    return climb.thrust, out["roll"] * FULL_LEAN_RAD, -out["pitch"] * FULL_LEAN_RAD, out["yaw"]


def rates(wanted: Motion, measured: Measured, climb: Climb) -> Four:
    """Return thrust, and body rates that close the loop on the lean of ``attitude``."""
    thrust, roll_rad, pitch_rad, yaw_rate = attitude(wanted, measured, climb)
    roll_rate = clip(RATE_PER_LEAN * (roll_rad - measured.roll_rad), MAX_LEAN_RATE_RADPS)
    pitch_rate = clip(RATE_PER_LEAN * (pitch_rad - measured.pitch_rad), MAX_LEAN_RATE_RADPS)
    return thrust, roll_rate, pitch_rate, yaw_rate


Control: TypeAlias = Callable[[Motion, Measured, Climb], Four]
CONTROLS: dict[ActionKind, Control] = {
    "sticks": sticks,
    "rates": rates,
    "attitude": attitude,
    "velocity": velocity,
}


def _leans(wanted: Motion, measured: Measured) -> tuple[float, float]:
    """Return the leans forward and to the right, as shares of the full lean."""
    forward = LEAN_PER_WANTED_MPS * wanted.forward_mps
    forward += LEAN_PER_MPS * (wanted.forward_mps - measured.forward_mps)
    right = LEAN_PER_WANTED_MPS * wanted.right_mps
    right += LEAN_PER_MPS * (wanted.right_mps - measured.right_mps)
    # A turn at speed v needs the sideways acceleration v * yaw_rate.
    right += wanted.forward_mps * wanted.yaw_rate_radps / FULL_LEAN_ACCEL_MPS2
    return clip(forward, MAX_LEAN), clip(right, MAX_LEAN)


def _yaw_rate(wanted: Motion, measured: Measured) -> float:
    """Return the commanded yaw rate [rad/s]."""
    error = wanted.yaw_rate_radps - measured.yaw_rate_radps
    return wanted.yaw_rate_radps + YAW_RATE_GAIN * error
