"""``mavbridge identify``: fly a doublet, and compare the vehicle with a policy's training."""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from typing import Literal, NamedTuple

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
Motion = Literal["lean", "rate", "speed"]
"""Of the vehicle: + is right, forward, nose right, up."""
UNITS: dict[Motion, tuple[str, str]] = {
    "lean": ("deg", "attitude_ns"),
    "rate": ("deg/s", "rate_ns"),
    "speed": ("m/s", "velocity_ns"),
}
"""Unit of each motion, and the field of a state with its measurement time."""
_DEG = math.degrees(1.0)
MAX_ROWS = 100_000
"""Most ticks kept: four minutes at 400 Hz. The oldest are dropped first."""
STEP_S, MOST_DEAD, LEAD = 0.01, 60, 110
"""Grid of the fit; longest dead time, and span of actions before the first motion, in its steps."""
LAGS_S = np.geomspace(0.01, 1.5, 73)
STRIDE = 2
"""Stride of the first search; a second one looks at the neighbours of its result."""
OUTLIER_MADS, LEAST_R_SQUARED = 6.0, 0.7
STEADY, RESTED = 0.1, np.array([0.01, 0.1])
"""Most change at the end of a push, in shares of the value: of a steady action, and of a motion at
rest, in the first and in the second push. The first tells a limited rate from a slow lag."""
EARLY_S, BEFORE_S, STILL_S, LONGEST_GAP_S, CLIMB_S = 0.12, 0.1, 1.0, 0.25, 20.0
"""Time by which a push ends early because of the smoothing's lag; time used before a push, and at
the end of a pause; longest gap in sends of a flying policy; time to climb before the doublet."""


class Channel(NamedTuple):
    """One axis: a number of the action, and the resulting motion."""

    axis: Axis
    column: int
    scale: float
    """Factor from the number of the action to the motion's unit, or to shares of full stick."""
    motion: Motion


READ: dict[tuple[Axis, Motion], Callable[[FloatArray], float]] = {
    ("roll", "lean"): lambda state: _DEG * measure(state).roll_rad,
    ("pitch", "lean"): lambda state: -_DEG * measure(state).pitch_rad,
    ("roll", "rate"): lambda state: _DEG * float(state[RATE][0]),
    ("pitch", "rate"): lambda state: -_DEG * float(state[RATE][1]),
    ("yaw", "rate"): lambda state: _DEG * float(state[RATE][2]),
    ("roll", "speed"): lambda state: measure(state).right_mps,
    ("pitch", "speed"): lambda state: measure(state).forward_mps,
    ("climb", "speed"): lambda state: measure(state).climb_mps,
}
"""Motion about or along an axis in a 13-D state."""
_YAW = Channel("yaw", 3, _DEG, "rate")
CHANNELS: dict[ActionKind, tuple[Channel, ...]] = {
    "sticks": (
        Channel("roll", 3, 1.0, "lean"),
        Channel("pitch", 2, 1.0, "lean"),
        Channel("yaw", 1, 1.0, "rate"),
        Channel("climb", 0, 1.0, "speed"),
    ),
    "attitude": (Channel("roll", 1, _DEG, "lean"), Channel("pitch", 2, -_DEG, "lean"), _YAW),
    "rates": (Channel("roll", 1, _DEG, "rate"), Channel("pitch", 2, -_DEG, "rate"), _YAW),
    "velocity": (
        Channel("roll", 1, 1.0, "speed"),
        Channel("pitch", 0, 1.0, "speed"),
        _YAW,
        Channel("climb", 2, -1.0, "speed"),
    ),
}
"""Axes pushed by the doublet of each kind of action."""


class ResponseRecording:
    """``TickSink`` that keeps the policy's actions and the states that they are based on."""

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Action]] = deque(maxlen=MAX_ROWS)
        self._states: deque[VehicleState] = deque(maxlen=MAX_ROWS)

    def emit(self, event: Event) -> None:
        """Keep a tick in which the policy flew; see ``mavbridge.core.records.TickSink``."""
        if not isinstance(event, Tick) or event.trace is None:
            return
        # The policy's action after its limits, before any mapping to this vehicle's curves.
        self._sent.append((event.sent_ns, event.trace.smoothed))
        state = event.state
        if state is not None and (not self._states or state is not self._states[-1]):
            self._states.append(state)

    def inputs(self, column: int, scale: float = 1.0) -> tuple[Array, Array]:
        """Return times in s and values of one number of the actions."""
        times = np.array([at_ns for at_ns, _ in self._sent], np.float64) / NS_PER_S
        return times, scale * np.array([action[column] for _, action in self._sent], np.float64)

    def outputs(self, channel: Channel) -> tuple[Array, Array]:
        """Return times in s and values of a motion, without repeated times."""
        read, stamp = READ[channel.axis, channel.motion], UNITS[channel.motion][1]
        times = np.array([getattr(state, stamp) for state in self._states], np.int64)
        values = np.array([read(state.values) for state in self._states], np.float64)
        _, first = np.unique(times, return_index=True)
        return times[first].astype(np.float64) / NS_PER_S, values[first]


@dataclass(frozen=True, slots=True, kw_only=True)
class PushResult:
    """One axis pushed at one amplitude to both sides."""

    axis: Axis
    motion: Motion
    unit: str
    action: Sides
    """In shares of full stick, or in the unit of the motion."""
    measured: Sides
    """Settled motion of the vehicle."""
    trained: Sides
    """Motion expected by the policy's training."""
    dead_time_s: float
    time_63_s: float
    """Time from a step of the action to 63 % of its effect."""
    r_squared: float
    """Share of the motion's variance that dead time, lag and gains explain."""

    @property
    def ratio(self) -> tuple[float | None, float | None]:
        """Measured over trained; None if no motion was expected."""
        up, down = (m / t if t else None for m, t in zip(self.measured, self.trained, strict=True))
        return up, down


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
    pushes: list[PushResult] = []
    missing: list[str] = []
    channels = {channel.axis: channel for channel in CHANNELS[contract.action]}
    steps = doublet_steps(contract.action)
    for step in steps:
        found = _fit_push(recording, channels[step.axis], step, contract, program_start_s)
        if isinstance(found, PushResult):
            pushes.append(found)
        else:
            missing.append(f"{step.axis} at {step.share:.0%}: {found}")
    hover = None
    if contract.action in ("rates", "attitude"):
        input_s, thrust = recording.inputs(0)
        ends_s = [program_start_s + step.end_s + step.settle_s for step in steps]
        still = [(input_s >= end_s - STILL_S) & (input_s < end_s) for end_s in ends_s]
        rested = thrust[np.any(still, axis=0)]
        hover = float(np.median(rested)) if len(rested) else None
    return Identification(pushes=tuple(pushes), missing=tuple(missing), policy_hover_thrust=hover)


def _fit_push(
    recording: ResponseRecording,
    channel: Channel,
    step: DoubletStep,
    contract: Contract,
    program_start_s: float,
) -> PushResult | str:
    """Return the result of one push, or the reason why there is none."""
    begin_s, end_s = program_start_s + step.begin_s, program_start_s + step.end_s
    input_s, inputs = recording.inputs(channel.column, channel.scale)
    within = (input_s >= begin_s) & (input_s <= end_s)
    if np.diff(np.concatenate([[begin_s], input_s[within], [end_s]])).max() > LONGEST_GAP_S:
        return "the policy did not fly all of it"
    pushing = inputs[within & (input_s < end_s - EARLY_S)]  # feedback may return before the end
    up, down = float(pushing.max(initial=0.0)), float(pushing.min(initial=0.0))
    if up <= 0.0 or down >= 0.0:
        return "it was not pushed to both sides"
    grid_s = np.arange(begin_s - BEFORE_S - LEAD * STEP_S, end_s - EARLY_S, STEP_S)
    held = inputs[np.clip(np.searchsorted(input_s, grid_s, side="right") - 1, 0, None)]
    at_s, pushed = grid_s[LEAD:], held[LEAD:]
    moved = np.interp(at_s, *recording.outputs(channel))
    ends_s = (begin_s + step.half_s - EARLY_S, end_s - EARLY_S)
    late = [(at_s >= last_s - step.half_s / 4) & (at_s < last_s) for last_s in ends_s]
    is_steady = all(np.ptp(pushed[each]) <= STEADY * abs(pushed[each].mean()) for each in late)
    settled = late[0] | late[1] if is_steady else np.full(len(at_s), True)
    known = _rested_gains(pushed, moved, late) if is_steady else None
    if known is not None:  # the first push began at rest, and shows dead time and lag
        count = int(np.searchsorted(at_s, ends_s[0]))
        held, moved, settled = held[: LEAD + count], moved[:count], settled[:count]
    fit = _fit_response(held, moved, settled, known) if np.ptp(moved) > 0.0 else None
    if fit is None or fit.r_squared < LEAST_R_SQUARED:
        return "the motion does not follow the action"
    trained = [_trained_motion(contract, channel, amount) for amount in (up, down)]
    return PushResult(
        axis=step.axis,
        motion=channel.motion,
        unit=UNITS[channel.motion][0],
        action=(up, down),
        measured=(fit.gains[0] * up, fit.gains[1] * down),
        trained=(trained[0], trained[1]),
        dead_time_s=fit.dead_time_s,
        time_63_s=fit.dead_time_s + fit.lag_s,
        r_squared=fit.r_squared,
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
    return motion if channel.motion == "speed" else math.degrees(motion)


class _Response(NamedTuple):
    """Dead time, then a first-order lag; gains are motion per unit of action."""

    gains: Sides
    dead_time_s: float
    lag_s: float
    r_squared: float


def _rested_gains(pushed: Array, moved: Array, late: list[Mask]) -> Array | None:
    """Return the gain of each push from its end; None if the motion does not rest there."""
    medians = [[np.median(half) for half in np.array_split(moved[end], 2)] for end in late]
    earlier, later = np.array(medians).T
    is_at_rest = np.all(np.abs(later - earlier) <= RESTED * np.abs(later))
    return later / [pushed[end].mean() for end in late] if is_at_rest else None


def _fit_response(held: Array, moved: Array, settled: Mask, known: Array | None) -> _Response:
    """Fit ``moved = gain * lag(held, dead time earlier)``, with a gain for each sign.

    Gains not known are those of the samples ``settled``: all would give 10 % less for a full yaw
    rate, 14 % for a full climb (bundled ArduPilot). A second fit leaves outliers out.
    """
    signs = np.stack([np.maximum(held, 0.0), np.minimum(held, 0.0)], axis=-1)
    share = (1.0 - np.exp(-STEP_S / LAGS_S))[:, None]
    lagged = np.zeros((len(held), len(LAGS_S), 2))
    for index, now in enumerate(signs[:-1]):  # an action takes effect from its own time on
        lagged[index + 1] = lagged[index] + share * (now - lagged[index])

    def missed(dead: int, lag: int) -> tuple[Array, Array]:
        """Return what a fit does not explain, and its gains."""
        sides, told = lagged[LEAD - dead : len(lagged) - dead, lag], settled & kept
        gains = np.linalg.lstsq(sides[told], moved[told], rcond=None)[0] if known is None else known
        return moved - sides @ gains, gains

    kept = np.full(len(moved), True)
    deads, lags = range(0, MOST_DEAD + 1, STRIDE), range(0, len(LAGS_S), STRIDE)
    for _ in range(2):
        pairs = [(dead, lag) for dead in deads for lag in lags]
        dead, lag = min(pairs, key=lambda pair: np.square(missed(*pair)[0][kept]).sum())
        rest, gains = missed(dead, lag)
        kept = np.abs(rest) <= max(OUTLIER_MADS * float(np.median(np.abs(rest))), 1e-9)
        deads = range(max(dead - STRIDE, 0), dead + STRIDE + 1)
        lags = range(max(lag - STRIDE, 0), min(lag + STRIDE + 1, len(LAGS_S)))
    return _Response(
        gains=(float(gains[0]), float(gains[1])),
        dead_time_s=dead * STEP_S,
        lag_s=float(LAGS_S[lag]),
        r_squared=1.0 - float(np.square(rest).mean() / moved.var()),
    )


def print_identification(found: Identification, contract: Contract, console: Console) -> None:
    """Print every push, the policy's hover thrust, and the missing results."""
    is_sticks = contract.action == "sticks"
    given, expected = ("stick", "trained with") if is_sticks else ("commanded", "expected")
    header = ["axis", given, "motion", "measured", expected, "ratio", "dead time", "63 %"]
    rows = [
        [
            push.axis,
            f"{push.action[0]:.0%}" if is_sticks else f"{push.action[0]:.2f}",
            f"{push.motion}, {push.unit}",
            "{:+.2f} {:+.2f}".format(*push.measured),
            "{:+.2f} {:+.2f}".format(*push.trained),
            " ".join("-" if ratio is None else f"{ratio:.2f}" for ratio in push.ratio),
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


def as_document(
    found: Identification, contract: Contract, config: IdentifyConfig
) -> dict[str, object]:
    """Return all results for ``--json``; a ratio is null if the policy expected no motion."""
    return {
        "policy": config.flight.policy.policy,
        "action": contract.action,
        "trained_hover_thrust": contract.hover_thrust,
        "policy_hover_thrust": found.policy_hover_thrust,
        "pushes": [asdict(push) | {"ratio": push.ratio} for push in found.pushes],
        "missing": found.missing,
    }


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
            write_json(config.json, as_document(found, trained, config))
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
