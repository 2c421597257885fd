"""``mavbridge identify``: fly a doublet, and compare the vehicle with a policy's training."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Literal

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
_NONE = 1e-9
"""Motion that counts as none."""
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
Quantity = Literal["lean", "rate", "speed"]
UNITS: dict[Quantity, tuple[str, float, str]] = {
    "lean": ("deg", math.degrees(1.0), "attitude_ns"),
    "rate": ("deg/s", math.degrees(1.0), "rate_ns"),
    "speed": ("m/s", 1.0, "velocity_ns"),
}
"""Unit, factor to it, and the field of a state with the measurement time."""
LEANS: dict[ActionKind, Quantity] = {
    "sticks": "lean",
    "attitude": "lean",
    "rates": "rate",
    "velocity": "speed",
}
"""Roll and pitch by each kind of action; yaw is a rate, climb a speed."""


def measured_motion(state: FloatArray) -> dict[Quantity, dict[Axis, float]]:
    """Return the motion in a 13-D state, in rad and m/s: + is right, forward, nose right, up."""
    motion, (roll, pitch, yaw) = measure(state), state[RATE].tolist()
    return {
        "lean": {"roll": motion.roll_rad, "pitch": -motion.pitch_rad},
        "rate": {"roll": roll, "pitch": -pitch, "yaw": yaw},
        "speed": {"roll": motion.right_mps, "pitch": motion.forward_mps, "climb": motion.climb_mps},
    }


def trained_motion(contract: Contract, action: Action) -> dict[Axis, float]:
    """Return the motion that a policy expects of an action, as ``measured_motion`` does."""
    first, second, third, yaw = action
    if contract.action == "sticks":
        climb, yaw, pitch, roll = motion_of_sticks(contract, *action)
        return {"roll": roll, "pitch": pitch, "yaw": yaw, "climb": climb}
    if contract.action == "velocity":
        return {"roll": second, "pitch": first, "yaw": yaw, "climb": -third}
    return {"roll": second, "pitch": -third, "yaw": yaw}


class ResponseRecording:
    """``TickSink`` that keeps the policy's actions and the states that they are based on."""

    def __init__(self) -> None:
        self._rows: deque[tuple[int, Action, VehicleState]] = deque(maxlen=MAX_ROWS)

    def emit(self, event: Event) -> None:
        """Keep a tick in which the policy flew; see ``mavbridge.core.records.TickSink``."""
        if isinstance(event, Tick) and event.trace is not None and event.state is not None:
            # The policy's action after its limits, before any mapping to this vehicle's curves.
            self._rows.append((event.sent_ns, event.trace.smoothed, event.state))

    def inputs(self, read: Callable[[Action], float]) -> tuple[Array, Array]:
        """Return times in s and values of something read from the actions."""
        times = np.array([at_ns for at_ns, _, _ in self._rows], np.float64) / NS_PER_S
        return times, np.array([read(action) for _, action, _ in self._rows], np.float64)

    def outputs(self, axis: Axis, quantity: Quantity) -> tuple[Array, Array]:
        """Return times in s and values of a motion, without repeated times."""
        stamp = UNITS[quantity][2]
        states = {getattr(state, stamp): state.values for _, _, state in self._rows}
        values = [measured_motion(states[at_ns])[quantity][axis] for at_ns in sorted(states)]
        return np.array(sorted(states), np.float64) / NS_PER_S, np.array(values)


@dataclass(frozen=True, slots=True, kw_only=True)
class PushResult:
    """One axis pushed to both sides."""

    axis: Axis
    motion: str
    """With its unit."""
    trained: Sides
    """Motion that the policy's training expects of the actions."""
    measured: Sides
    """Settled motion of the vehicle."""
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
    found = {step.axis: _fit_push(recording, step, contract) for step in steps}
    hover = None
    if contract.action in ("rates", "attitude"):
        at_s, thrust = recording.inputs(lambda action: action[0])
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
    recording: ResponseRecording, step: DoubletStep, contract: Contract
) -> PushResult | str:
    """Return the result of one push, or the reason why there is none; ``step`` is on the clock of
    the stamps."""
    axis = step.axis
    quantity: Quantity = "rate" if axis == "yaw" else "speed"
    if axis in ("roll", "pitch"):
        quantity = LEANS[contract.action]
    unit, scale, _ = UNITS[quantity]
    input_s, inputs = recording.inputs(lambda action: trained_motion(contract, action)[axis])
    flown_s = input_s[(input_s >= step.begin_s) & (input_s <= step.end_s)]
    if np.diff(np.concatenate([[step.begin_s], flown_s, [step.end_s]])).max() > LONGEST_GAP_S:
        return "the policy did not fly all of it"
    grid_s = np.arange(step.begin_s - LEAD * STEP_S, step.end_s - EARLY_S, STEP_S)
    at_s, latest = grid_s[LEAD:], np.searchsorted(input_s, grid_s, side="right") - 1
    held = scale * inputs[np.maximum(latest, 0)]
    pushed = held[LEAD:]
    moved = scale * np.interp(at_s, *recording.outputs(axis, quantity))
    if not pushed.min() < 0.0 < pushed.max():
        return "it was not pushed to both sides"
    left_s = (step.end_s - EARLY_S - at_s) % (step.half_s + step.rest_s)
    late = left_s < step.half_s / 4  # the end of each of the two pushes
    size = np.abs(pushed[late])
    settled = late if np.ptp(size) <= STEADY * size.mean() else np.full(len(at_s), True)
    ratio, dead_time_s, lag_s, explained = _fit_response(held, moved, settled)
    if explained < LEAST_EXPLAINED:
        return "the motion does not follow the action"
    trained = float(pushed.max()), float(pushed.min())
    return PushResult(
        axis=axis,
        motion=f"{quantity}, {unit}",
        trained=trained,
        measured=(ratio[0] * trained[0], ratio[1] * trained[1]),
        ratio=ratio,
        dead_time_s=dead_time_s,
        time_63_s=dead_time_s + lag_s,
    )


def _fit_response(held: Array, moved: Array, settled: Mask) -> tuple[Sides, float, float, float]:
    """Fit ``moved = gain * lag(held, dead time earlier)``, with a gain for each sign of ``held``.

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
    header = ["axis", "motion", "trained", "measured", "ratio", "dead time", "63 %"]
    rows = [
        [
            push.axis,
            push.motion,
            "{:+.2f} {:+.2f}".format(*push.trained),
            "{:+.2f} {:+.2f}".format(*push.measured),
            "{:.2f} {:.2f}".format(*push.ratio),
            f"{1e3 * push.dead_time_s:.0f} ms",
            f"{1e3 * push.time_63_s:.0f} ms",
        ]
        for push in found.pushes
    ]
    console.print(make_table("what the vehicle does", header, rows, left_columns=2))
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
