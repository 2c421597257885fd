"""From the recording of a flown doublet to what each push did, axis by axis."""

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mavbridge.commands.identify.fit import Array, ResponseRecording, fit_response
from mavbridge.core.records import VehicleState
from policy.contract import RATE, ActionKind, Contract
from policy.scripted.controllers import measure
from policy.scripted.programs import Axis, DoubletStep, doublet_steps

_DEGREES = math.degrees(1.0)
BEFORE_S = 0.1
"""Length of the motion before a push that is looked at."""
EARLY_S = 0.12
"""A push ends by so much before its time: chunks are linear between their actions, and sampled
ahead by the lag of the smoothing."""
LONGEST_GAP_S = 0.25
"""Between two actions; a longer one means that the policy did not fly all the time."""
LEAST_R_SQUARED = 0.7
SETTLED = 0.1
"""Most change between the last two eighths of a push, of the whole, at which it has settled."""
STILL_S = 1.0
"""Length of the end of each pause that is looked at: by then the vehicle hovers."""


class Signal(NamedTuple):
    """Something that a state measures. + is right, forward, nose right, up."""

    name: str
    unit: str
    read: Callable[[VehicleState], float]
    measured_ns: Callable[[VehicleState], int]


class AxisChannel(NamedTuple):
    """One axis: a number of the action, and the motion that answers it."""

    axis: Axis
    column: int
    scale: float
    """From the number of the action to the signal's unit, or to shares of full stick; with the
    signs of the signal."""
    signal: Signal


_LEAN_RIGHT = Signal(
    "lean", "deg", lambda s: _DEGREES * measure(s.values).roll_rad, lambda s: s.attitude_ns
)
_LEAN_FORWARD = Signal(
    "lean", "deg", lambda s: -_DEGREES * measure(s.values).pitch_rad, lambda s: s.attitude_ns
)
_ROLL_RATE, _PITCH_RATE, _YAW_RATE = (
    Signal(name, "deg/s", read, lambda s: s.rate_ns)
    for name, read in (
        ("roll rate", lambda s: _DEGREES * float(s.values[RATE][0])),
        ("pitch rate", lambda s: -_DEGREES * float(s.values[RATE][1])),
        ("yaw rate", lambda s: _DEGREES * float(s.values[RATE][2])),
    )
)
_SPEED_RIGHT, _SPEED_FORWARD, _CLIMB_RATE = (
    Signal(name, "m/s", read, lambda s: s.velocity_ns)
    for name, read in (
        ("speed", lambda s: measure(s.values).right_mps),
        ("speed", lambda s: measure(s.values).forward_mps),
        ("climb rate", lambda s: measure(s.values).climb_mps),
    )
)
CHANNELS: dict[ActionKind, tuple[AxisChannel, ...]] = {
    "sticks": (
        AxisChannel("roll", 3, 1.0, _LEAN_RIGHT),
        AxisChannel("pitch", 2, 1.0, _LEAN_FORWARD),
        AxisChannel("yaw", 1, 1.0, _YAW_RATE),
        AxisChannel("climb", 0, 1.0, _CLIMB_RATE),
    ),
    "attitude": (
        AxisChannel("roll", 1, _DEGREES, _LEAN_RIGHT),
        AxisChannel("pitch", 2, -_DEGREES, _LEAN_FORWARD),
        AxisChannel("yaw", 3, _DEGREES, _YAW_RATE),
    ),
    "rates": (
        AxisChannel("roll", 1, _DEGREES, _ROLL_RATE),
        AxisChannel("pitch", 2, -_DEGREES, _PITCH_RATE),
        AxisChannel("yaw", 3, _DEGREES, _YAW_RATE),
    ),
    "velocity": (
        AxisChannel("roll", 1, 1.0, _SPEED_RIGHT),
        AxisChannel("pitch", 0, 1.0, _SPEED_FORWARD),
        AxisChannel("yaw", 3, _DEGREES, _YAW_RATE),
        AxisChannel("climb", 2, -1.0, _CLIMB_RATE),
    ),
}
"""The axes that the doublet of each kind of action pushes."""

SIMULATOR_TIME_63_S: dict[ActionKind, dict[Axis, float]] = {
    "sticks": {"roll": 0.16, "pitch": 0.16, "yaw": 0.20, "climb": 0.67},
    "attitude": {},
    "rates": {},
    "velocity": {},
}
"""From a step of the action to 63 % of its effect on the bundled simulator with ArduCopter's
defaults, at the larger push, by this command: what the shipped policy was trained on."""


def trained_motion(contract: Contract, axis: Axis, amount: float) -> float:
    """Motion that a policy expects of an action held at ``amount`` on one axis.

    Args:
        contract: the policy's.
        axis: the axis.
        amount: of full stick where the actions are sticks; else what is commanded, and expected.
    """
    if contract.action != "sticks":
        return amount
    match axis:
        case "roll" | "pitch":
            full, dead_zone = contract.full_lean_deg, contract.lean_dead_zone
        case "yaw":
            full, dead_zone = contract.full_yaw_rate_degps, contract.yaw_dead_zone
        case "climb":
            full = contract.full_climb_mps if amount > 0.0 else contract.full_descent_mps
            dead_zone = contract.throttle_dead_zone
    beyond = max(0.0, abs(amount) - dead_zone) / (1.0 - dead_zone)
    return math.copysign(full * beyond, amount)


@dataclass(frozen=True, slots=True, kw_only=True)
class Side:
    """A push to one side."""

    amount: float
    """Largest action: of full stick, or in the unit of the motion. Negative to the other side."""
    reached: float
    """Motion, in its unit, that the vehicle would settle at."""
    trained: float
    """The motion that the policy was trained to expect."""

    @property
    def ratio(self) -> float:
        """Reached, of trained; infinite where nothing was to move."""
        return self.reached / self.trained if self.trained else math.inf


@dataclass(frozen=True, slots=True, kw_only=True)
class PushResult:
    """One axis pushed at one amplitude to both sides."""

    axis: Axis
    motion: str
    unit: str
    up: Side
    down: Side
    dead_time_s: float
    time_63_s: float
    """From a step of the action to 63 % of its effect."""
    r_squared: float
    """Share of the motion's variance that gain, dead time and lag explain."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Identification:
    """All that was measured."""

    pushes: tuple[PushResult, ...]
    missing: tuple[str, ...]
    """What could not be measured, and why."""
    hover_thrust: float | None
    """Where the actions have a thrust."""


def identify_pushes(
    recording: ResponseRecording, *, contract: Contract, program_start_s: float
) -> Identification:
    """Fit every push of the doublet that was flown.

    Args:
        recording: of the flight.
        contract: of the policy to compare with; the doublet was of its kind of action.
        program_start_s: when the doublet began, by the clock of the stamps.
    """
    pushes: list[PushResult] = []
    missing: list[str] = []
    channels = {channel.axis: channel for channel in CHANNELS[contract.action]}
    for step in doublet_steps(contract.action):
        found = _fit_push(recording, channels[step.axis], step, contract, program_start_s)
        if isinstance(found, PushResult):
            pushes.append(found)
        else:
            missing.append(f"{step.axis} at {step.share:.0%}: {found}")
    thrust = None
    if contract.action in ("rates", "attitude"):
        thrust = _hover_thrust(recording, contract.action, program_start_s)
    return Identification(pushes=tuple(pushes), missing=tuple(missing), hover_thrust=thrust)


def _fit_push(
    recording: ResponseRecording,
    channel: AxisChannel,
    step: DoubletStep,
    contract: Contract,
    program_start_s: float,
) -> PushResult | str:
    """The result of one push, or why there is none."""
    begin_s, end_s = program_start_s + step.begin_s, program_start_s + step.end_s
    input_s, inputs = recording.inputs(channel.column)
    inputs = inputs * channel.scale
    within = (input_s >= begin_s) & (input_s <= end_s)
    if not _is_covered(input_s[within], begin_s, end_s):
        return "the policy did not fly all of it"
    up, down = float(inputs[within].max()), float(inputs[within].min())
    if up <= 0.0 or down >= 0.0:
        return "it was not pushed to both sides"
    output_s, outputs = recording.outputs(channel.signal.read, channel.signal.measured_ns)
    ups = _settled_gain(input_s, inputs, output_s, outputs, begin_s + step.half_s, step.half_s)
    downs = _settled_gain(input_s, inputs, output_s, outputs, end_s, step.half_s)
    gains = None if ups is None or downs is None else (ups, downs)
    # Once the gains are known the first step says how fast it was: it began at rest.
    last_s = (end_s if gains is None else begin_s + step.half_s) - EARLY_S
    shown = (output_s >= begin_s - BEFORE_S) & (output_s <= last_s)
    response = fit_response(input_s, inputs, output_s[shown], outputs[shown], gains=gains)
    if response is None or response.r_squared < LEAST_R_SQUARED:
        return "the motion does not follow the action"
    return PushResult(
        axis=channel.axis,
        motion=channel.signal.name,
        unit=channel.signal.unit,
        up=_side(contract, channel.axis, up, response.gain_up),
        down=_side(contract, channel.axis, down, response.gain_down),
        dead_time_s=response.dead_time_s,
        time_63_s=response.time_63_s,
        r_squared=response.r_squared,
    )


def _settled_gain(
    input_s: Array, inputs: Array, output_s: Array, outputs: Array, end_s: float, half_s: float
) -> float | None:
    """Motion for each unit of a push, from its last eighth; None where one of them still moves."""
    edges_s = end_s - EARLY_S - half_s * np.array([0.25, 0.125, 0.0])
    pushed = inputs[(input_s >= edges_s[0]) & (input_s < edges_s[-1])]
    moved = [
        outputs[(output_s >= low) & (output_s < high)] for low, high in itertools.pairwise(edges_s)
    ]
    if len(pushed) < 2 or min(map(len, moved)) < 2:
        return None
    earlier, later = (float(np.median(values)) for values in moved)
    push = float(np.median(pushed))
    if np.ptp(pushed) > SETTLED * abs(push) or abs(later - earlier) > SETTLED * abs(later):
        return None
    return later / push


def _side(contract: Contract, axis: Axis, amount: float, gain: float) -> Side:
    return Side(
        amount=amount, reached=gain * amount, trained=trained_motion(contract, axis, amount)
    )


def _is_covered(times_s: Array, begin_s: float, end_s: float) -> bool:
    moments = np.concatenate([[begin_s], times_s, [end_s]])
    return bool(np.diff(moments).max() <= LONGEST_GAP_S)


def _hover_thrust(
    recording: ResponseRecording, action: ActionKind, program_start_s: float
) -> float | None:
    """Median thrust at the end of the pauses."""
    input_s, thrust = recording.inputs(0)
    still = np.zeros(len(input_s), bool)
    for step in doublet_steps(action):
        end_s = program_start_s + step.end_s + step.settle_s
        still |= (input_s >= end_s - STILL_S) & (input_s < end_s)
    return float(np.median(thrust[still])) if still.any() else None


@dataclass(frozen=True, slots=True, kw_only=True)
class FullStick:
    """Motion at full stick to one side, by a line through two amplitudes."""

    reached: float
    trained: float
    dead_zone: float
    """Share of the stick's travel at which the line meets zero."""


def full_stick(
    pushes: Sequence[PushResult], contract: Contract, *, is_up: bool
) -> FullStick | None:
    """Extrapolate the pushes of one axis to full stick; None without two amplitudes."""
    sides = [push.up if is_up else push.down for push in pushes]
    if len(sides) != 2 or sides[0].amount == sides[1].amount:
        return None
    low, high = sides
    slope = (high.reached - low.reached) / (high.amount - low.amount)
    full = 1.0 if is_up else -1.0
    return FullStick(
        reached=high.reached + slope * (full - high.amount),
        trained=trained_motion(contract, pushes[0].axis, full),
        dead_zone=max(0.0, abs(low.amount - low.reached / slope)) if slope else 0.0,
    )
