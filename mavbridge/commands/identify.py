"""``mavbridge identify``: fly a doublet, and compare the vehicle with a policy's training."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console

from mavbridge.commands.config import IdentifyConfig
from mavbridge.commands.output import make_table, table_console, write_json
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import MavbridgeError, PeerError, UserError
from mavbridge.core.files import empty_folders_removed, require_writable
from mavbridge.core.records import Event, Tick, VehicleState
from mavbridge.core.vehicle import Action
from mavbridge.flight.app import fly_policy
from mavbridge.flight.checks import check_flight, output_folders
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import policy_request
from mavbridge.observe.output import patient_console
from policy.contract import RATE, STICK_TERMS, ActionKind, Contract, FloatArray
from policy.engines.runner import ExecutionSettings, make_numpy_runner
from policy.loading.load import read_policy_contract
from policy.motion.controllers import Axis, DoubletStep, doublet_length_s, doublet_steps, measure
from policy.motion.scripted import ScriptedPolicy
from policy.motion.stick_loop import motion_of_sticks
from policy.protocol import PolicyRunner

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Sides = tuple[float, float]
"""Value for the positive side, value for the negative side."""
_DEG, _NONE = math.degrees(1.0), 1e-9
"""One radian; a motion that counts as none."""
MAX_ROWS = 100_000
"""Most ticks kept: four minutes at 400 Hz. The oldest are dropped first."""
STEP_S, LEAD = 0.01, 60
"""Grid of the fit; longest dead time, in its steps, for which actions before a push are used."""
LAGS_S = np.geomspace(0.01, 1.5, 40)
EARLY_S, STILL_S, LONGEST_GAP_S, CLIMB_S = 0.12, 1.0, 0.25, 20.0
"""Time by which a push ends early because of the smoothing's lag; time used at the end of a pause;
longest gap in sends of a flying policy; time to climb before the doublet."""
STEADY, LEAST_EXPLAINED = 0.1, 0.5
"""Most change of a steady action, as a share of it; least share of a motion to be explained."""


class Channel(NamedTuple):
    """One axis: a number of the action, and the resulting motion in a 13-D state."""

    axis: Axis
    column: int
    scale: float
    """Factor from the number of the action to the motion's unit, or to shares of full stick."""
    motion: str
    """With its unit; + is right, forward, nose right, up."""
    stamp: str
    """Field of a ``VehicleState`` with the time of the motion."""
    read: Callable[[FloatArray], float]


_LEAN, _RATE = ("lean, deg", "attitude_ns"), ("rate, deg/s", "rate_ns")
_SPEED = ("speed, m/s", "velocity_ns")
_ROLL = (*_LEAN, lambda state: _DEG * measure(state).roll_rad)
_PITCH = (*_LEAN, lambda state: -_DEG * measure(state).pitch_rad)
_YAW = (*_RATE, lambda state: _DEG * measure(state).yaw_rate_radps)
_CLIMB = (*_SPEED, lambda state: measure(state).climb_mps)
CHANNELS: dict[ActionKind, tuple[Channel, ...]] = {
    "sticks": (
        Channel("roll", 3, 1.0, *_ROLL),
        Channel("pitch", 2, 1.0, *_PITCH),
        Channel("yaw", 1, 1.0, *_YAW),
        Channel("climb", 0, 1.0, *_CLIMB),
    ),
    "attitude": (
        Channel("roll", 1, _DEG, *_ROLL),
        Channel("pitch", 2, -_DEG, *_PITCH),
        Channel("yaw", 3, _DEG, *_YAW),
    ),
    "rates": (
        Channel("roll", 1, _DEG, *_RATE, lambda state: _DEG * float(state[RATE][0])),
        Channel("pitch", 2, -_DEG, *_RATE, lambda state: -_DEG * float(state[RATE][1])),
        Channel("yaw", 3, _DEG, *_YAW),
    ),
    "velocity": (
        Channel("roll", 1, 1.0, *_SPEED, lambda state: measure(state).right_mps),
        Channel("pitch", 0, 1.0, *_SPEED, lambda state: measure(state).forward_mps),
        Channel("yaw", 3, _DEG, *_YAW),
        Channel("climb", 2, -1.0, *_CLIMB),
    ),
}
"""Axes pushed by the doublet of each kind of action."""


class ResponseRecording:
    """``TickSink`` that keeps the policy's actions and the states that they are based on."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, Action, VehicleState]] = deque(maxlen=MAX_ROWS)

    def emit(self, event: Event) -> None:
        """Keep a tick in which the policy flew; see ``mavbridge.core.records.TickSink``."""
        if isinstance(event, Tick) and event.trace is not None and event.state is not None:
            # The policy's action after its limits, before any mapping to this vehicle's curves.
            self._rows.append((event.sent_ns, event.trace.smoothed, event.state))

    def inputs(self, column: int) -> tuple[Array, Array]:
        """Return times in s and values of one number of the actions."""
        times = np.array([at_ns for at_ns, _, _ in self._rows], np.float64) / NS_PER_S
        return times, np.array([action[column] for _, action, _ in self._rows], np.float64)

    def outputs(self, channel: Channel) -> tuple[Array, Array]:
        """Return times in s and values of a motion, without repeated times."""
        states = {getattr(state, channel.stamp): state.values for _, _, state in self._rows}
        values = [channel.read(states[at_ns]) for at_ns in sorted(states)]
        return np.array(sorted(states), np.float64) / NS_PER_S, np.array(values)


@dataclass(frozen=True, slots=True, kw_only=True)
class PushResult:
    """One axis pushed to both sides."""

    axis: Axis
    motion: str
    """With its unit."""
    action: Sides
    """In shares of full stick, or in the unit of the motion."""
    measured: Sides
    """Settled motion of the vehicle."""
    trained: Sides
    """Motion expected by the policy's training."""
    ratio: Sides
    """Measured over trained."""
    dead_time_s: float
    time_63_s: float
    """Time from a step of the action to 63 % of its effect."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Identification:
    """All results, and the missing ones with their reasons."""

    pushes: tuple[PushResult, ...]
    missing: tuple[str, ...]
    policy_hover_thrust: float | None
    """Policy's thrust that hovers, before the guard scales it by the vehicle's hover parameter."""


def identify_pushes(
    recording: ResponseRecording, *, contract: Contract, program_start_s: float
) -> Identification:
    """Fit every push of the flown doublet, which began at ``program_start_s`` on the clock of the
    stamps; ``contract`` is of the policy to compare with."""
    steps = doublet_steps(contract.action, program_start_s)
    found = {
        step.axis: _fit_push(recording, channel, step, contract)
        for step, channel in zip(steps, CHANNELS[contract.action], strict=True)
    }
    hover = None
    if contract.action in ("rates", "attitude"):
        at_s, thrust = recording.inputs(0)
        ends_s = [step.end_s + step.settle_s for step in steps]
        still = [(at_s >= end_s - STILL_S) & (at_s < end_s) for end_s in ends_s]
        rested = thrust[np.any(still, axis=0)]
        hover = float(np.median(rested)) if len(rested) else None
    return Identification(
        pushes=tuple(push for push in found.values() if isinstance(push, PushResult)),
        missing=tuple(f"{axis}: {why}" for axis, why in found.items() if isinstance(why, str)),
        policy_hover_thrust=hover,
    )


def _fit_push(
    recording: ResponseRecording, channel: Channel, step: DoubletStep, contract: Contract
) -> PushResult | str:
    """Return the result of one push, or the reason why there is none; ``step`` is on the clock of
    the stamps."""
    input_s, inputs = recording.inputs(channel.column)
    flown_s = input_s[(input_s >= step.begin_s) & (input_s <= step.end_s)]
    if np.diff(np.concatenate([[step.begin_s], flown_s, [step.end_s]])).max() > LONGEST_GAP_S:
        return "the policy did not fly all of it"
    grid_s = np.arange(step.begin_s - LEAD * STEP_S, step.end_s - EARLY_S, STEP_S)
    at_s, latest = grid_s[LEAD:], np.searchsorted(input_s, grid_s, side="right") - 1
    held = channel.scale * inputs[np.maximum(latest, 0)]
    moved = np.interp(at_s, *recording.outputs(channel))
    action = float(held[LEAD:].max()), float(held[LEAD:].min())
    up, down = (_trained_motion(contract, channel, amount) for amount in action)
    if up <= 0.0 or down >= 0.0:
        return "it was not pushed to both sides"
    left_s = (step.end_s - EARLY_S - at_s) % (step.half_s + step.rest_s)
    late = left_s < step.half_s / 4  # the end of each of the two pushes
    size = np.abs(held[LEAD:][late])
    settled = late if np.ptp(size) <= STEADY * size.mean() else np.full(len(at_s), True)
    gains, dead_time_s, lag_s, explained = _fit_response(held, moved, settled)
    if explained < LEAST_EXPLAINED:
        return "the motion does not follow the action"
    measured = gains[0] * action[0], gains[1] * action[1]
    return PushResult(
        axis=step.axis,
        motion=channel.motion,
        action=action,
        measured=measured,
        trained=(up, down),
        ratio=(measured[0] / up, measured[1] / down),
        dead_time_s=dead_time_s,
        time_63_s=dead_time_s + lag_s,
    )


def _trained_motion(contract: Contract, channel: Channel, amount: float) -> float:
    """Return the motion that a policy expects of an action held at ``amount``.

    ``amount`` is in shares of full stick if the actions are sticks, else the commanded motion.
    """
    if contract.action != "sticks":
        return amount
    sticks = [0.0] * 4
    sticks[channel.column] = amount
    motion = motion_of_sticks(contract, *sticks)[channel.column]
    return motion if channel.axis == "climb" else math.degrees(motion)


def _fit_response(held: Array, moved: Array, settled: Mask) -> tuple[Sides, float, float, float]:
    """Fit ``moved = gain * lag(held, dead time earlier)``, with a gain for each sign.

    Return the gains, dead time and lag in s, and the share of the motion that they explain. Gains
    are those of the samples ``settled``: all would give 10 % less for a full yaw rate, 14 % for a
    full climb (bundled ArduPilot). Absolute errors count, so that gusts count little.
    """
    signs = np.stack([np.maximum(held, 0.0), np.minimum(held, 0.0)], axis=-1)
    share = (1.0 - np.exp(-STEP_S / LAGS_S))[:, None]
    lagged = np.zeros((len(held), len(LAGS_S), 2))
    for index, now in enumerate(signs[:-1]):  # an action takes effect from its own time on
        lagged[index + 1] = lagged[index] + share * (now - lagged[index])
    fits = []
    for dead in range(LEAD + 1):
        for lag, lag_s in enumerate(LAGS_S.tolist()):
            sides = lagged[LEAD - dead : len(lagged) - dead, lag]
            gains = np.linalg.lstsq(sides[settled], moved[settled], rcond=None)[0]
            fits.append((float(np.abs(moved - sides @ gains).sum()), dead * STEP_S, lag_s, gains))
    missed, dead_time_s, lag_s, (up, down) = min(fits, key=lambda fit: fit[0])
    explained = 1.0 - (missed + _NONE) / (float(np.abs(moved).sum()) + _NONE)
    return (float(up), float(down)), dead_time_s, lag_s, explained


def print_identification(found: Identification, contract: Contract, console: Console) -> None:
    """Print every push, the policy's hover thrust, and the missing results."""
    is_sticks = contract.action == "sticks"
    header = ["axis", "action", "motion", "measured", "trained", "ratio", "dead time", "63 %"]
    rows = [
        [
            push.axis,
            f"{push.action[0]:.0%}" if is_sticks else f"{push.action[0]:.2f}",
            push.motion,
            "{:+.2f} {:+.2f}".format(*push.measured),
            "{:+.2f} {:+.2f}".format(*push.trained),
            "{:.2f} {:.2f}".format(*push.ratio),
            f"{1e3 * push.dead_time_s:.0f} ms",
            f"{1e3 * push.time_63_s:.0f} ms",
        ]
        for push in found.pushes
    ]
    console.print(make_table("what the vehicle does", header, rows, left_columns=3))
    if (hover := found.policy_hover_thrust) is not None:
        told = f"hovers at a policy's thrust of {hover:.3f}, which is scaled for the vehicle;"
        console.print(f"{told} trained with {contract.hover_thrust:.3f}")
    for line in found.missing:
        console.print(f"not measured: {line}", style="yellow")


def identify(config: IdentifyConfig) -> int:
    """Fly the doublet, and print how the vehicle's gains and lags compare with the policy's."""
    clock = MonotonicClock()
    trained = read_policy_contract(policy_request(config.flight.policy))
    flight = doublet_flight(config, trained)
    require_writable(config.json, "--json")
    recording = ResponseRecording()
    with empty_folders_removed(*output_folders(flight)):
        check_flight(flight)
        policy, runner = doublet_policy(trained, clock, is_in_air=flight.takeoff is not None)
        plan = plan_flight(flight, runner.contract, is_dual=runner.dual_rate)
        code = fly_policy(plan, runner, clock=clock, console=patient_console(), sinks=(recording,))
    missing: tuple[str, ...] = ("the flight ended before the doublet began",)
    if policy.program_start_s is not None:
        found = identify_pushes(recording, contract=trained, program_start_s=policy.program_start_s)
        if found.pushes:
            print_identification(found, trained, table_console())
            names = {"policy": config.flight.policy.policy, "action": trained.action}
            hover = {"trained_hover_thrust": trained.hover_thrust}
            write_json(config.json, names | hover | asdict(found))
            return code
        missing = found.missing
    error: MavbridgeError = PeerError(f"nothing could be measured: {'; '.join(missing)}")
    error.exit_code = code or error.exit_code
    raise error


def doublet_flight(config: IdentifyConfig, trained: Contract) -> FlyConfig:
    """Return the flight of the flags, with the doublet in place of the policy."""
    flight = config.flight
    if flight.link.readonly:
        raise UserError("identify has to move the vehicle: leave out --readonly")
    return replace(
        flight,
        policy=PolicyConfig(policy=f"scripted:doublet:{trained.action}", dual_rate=True),
        camera=replace(flight.camera, camera=("none",), camera_latency=0.0),
        link=replace(flight.link, raw_sticks=True),  # the vehicle's own gains are measured
        duration=flight.duration or CLIMB_S + doublet_length_s(trained.action),
    )


def doublet_policy(
    trained: Contract, clock: Clock, *, is_in_air: bool
) -> tuple[ScriptedPolicy, PolicyRunner]:
    """Return the doublet in the policy's kind of action, with that policy's gains."""
    policy = ScriptedPolicy(
        "doublet",
        lambda: clock.now_ns() / NS_PER_S,
        action=trained.action,
        starts_in_air=is_in_air,
        contract=Contract(**{n: getattr(trained, n) for n in ("hover_thrust", *STICK_TERMS[1:])}),
    )
    runner = make_numpy_runner(policy, ExecutionSettings(name="scripted:doublet"))
    policy.reset()  # discard the state left by the trial on a dummy sample
    return policy, replace(runner, reset=policy.reset)
