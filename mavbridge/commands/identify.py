"""``mavbridge identify``: fly a doublet, and compare the vehicle with a policy's training."""

import json
import math
from dataclasses import asdict, dataclass, replace

import numpy as np
from rich.console import Console
from rich.text import Text

from mavbridge.commands.config import IdentifyConfig
from mavbridge.commands.output import make_table, table_console
from mavbridge.commands.step_response import (
    CHANNELS,
    UNITS,
    Channel,
    ResponseRecording,
    Sides,
    fit_response,
    settled_gain,
)
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.files import empty_folders_removed, require_writable, write_output
from mavbridge.flight.app import fly_policy
from mavbridge.flight.checks import check_flight, output_folders
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import configured_contract
from mavbridge.observe.output import flight_console
from policy.contract import Contract
from policy.engines.runner import ExecutionSettings, make_numpy_runner
from policy.motion.controllers import (
    Axis,
    DoubletStep,
    doublet_length_s,
    doublet_steps,
)
from policy.motion.scripted import ScriptedPolicy
from policy.motion.stick_loop import motion_of_sticks
from policy.protocol import PolicyRunner

LEAST_R_SQUARED = 0.7
EARLY_S, BEFORE_S, STILL_S, LONGEST_GAP_S, CLIMB_S = 0.12, 0.1, 1.0, 0.25, 20.0
"""Time by which a push ends early because of the smoothing's lag; time used before a push, and at
the end of a pause; longest gap in sends of a flying policy; time for the climb before the
doublet."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PushResult:
    """One axis pushed at one amplitude to both sides."""

    axis: Axis
    motion: str
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

    @property
    def ratio(self) -> tuple[float | None, float | None]:
        """Measured over trained; None if no motion was expected."""
        up, down = (m / t if t else None for m, t in zip(self.measured, self.trained, strict=True))
        return up, down


@dataclass(frozen=True, slots=True, kw_only=True)
class Identification:
    """All results, the missing ones with their reasons, and the hover thrust."""

    pushes: tuple[PushResult, ...]
    missing: tuple[str, ...]
    hover_thrust: float | None


def trained_motion(contract: Contract, channel: Channel, amount: float) -> float:
    """Return the motion that a policy expects of an action held at ``amount``.

    ``amount`` is in shares of full stick if the actions are sticks, else the commanded motion.
    """
    if contract.action != "sticks":
        return amount
    sticks = [0.0] * 4
    sticks[channel.column] = amount
    motion = motion_of_sticks(contract, *sticks)[channel.column]
    return motion if channel.motion == "speed" else math.degrees(motion)


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
    return Identification(pushes=tuple(pushes), missing=tuple(missing), hover_thrust=hover)


def _fit_push(
    recording: ResponseRecording,
    channel: Channel,
    step: DoubletStep,
    contract: Contract,
    program_start_s: float,
) -> PushResult | str:
    """Return the result of one push, or the reason why there is none."""
    begin_s, end_s = program_start_s + step.begin_s, program_start_s + step.end_s
    input_s, inputs = recording.inputs(channel.column)
    inputs = inputs * channel.scale
    within = (input_s >= begin_s) & (input_s <= end_s)
    if np.diff(np.concatenate([[begin_s], input_s[within], [end_s]])).max() > LONGEST_GAP_S:
        return "the policy did not fly all of it"
    up, down = float(inputs[within].max()), float(inputs[within].min())
    if up <= 0.0 or down >= 0.0:
        return "it was not pushed to both sides"
    output_s, outputs = recording.outputs(channel)
    data = (input_s, inputs, output_s, outputs)
    up_gain, down_gain = (
        settled_gain(*data, at_s - EARLY_S, step.half_s) for at_s in (begin_s + step.half_s, end_s)
    )
    known = None if up_gain is None or down_gain is None else (up_gain, down_gain)
    # With known gains the first step gives the speed, because it began at rest.
    last_s = (end_s if known is None else begin_s + step.half_s) - EARLY_S
    shown = (output_s >= begin_s - BEFORE_S) & (output_s <= last_s)
    response = fit_response(input_s, inputs, output_s[shown], outputs[shown], known)
    if response is None or response.r_squared < LEAST_R_SQUARED:
        return "the motion does not follow the action"
    gain_up, gain_down = response.gains
    return PushResult(
        axis=step.axis,
        motion=channel.motion,
        unit=UNITS[channel.motion][0],
        action=(up, down),
        measured=(gain_up * up, gain_down * down),
        trained=(
            trained_motion(contract, channel, up),
            trained_motion(contract, channel, down),
        ),
        dead_time_s=response.dead_time_s,
        time_63_s=response.dead_time_s + response.lag_s,
        r_squared=response.r_squared,
    )


def full_stick(pushes: list[PushResult]) -> Sides | None:
    """Return the motions at full stick of one axis, by a line through both amplitudes."""
    if len(pushes) != 2:
        return None
    low, high = pushes
    found = []
    for side, full in ((0, 1.0), (1, -1.0)):
        rise = high.measured[side] - low.measured[side]
        run = high.action[side] - low.action[side]
        found.append(high.measured[side] + rise / run * (full - high.action[side]) if run else 0.0)
    return found[0], found[1]


def print_identification(found: Identification, contract: Contract, console: Console) -> None:
    """Print every push, the hover thrust, and the missing results."""
    is_sticks = contract.action == "sticks"
    given, expected = ("stick", "trained with") if is_sticks else ("commanded", "expected")
    header = ["axis", given, "motion", "measured", expected, "ratio", "dead time", "63 %"]
    rows = []
    for push in found.pushes:
        rows.append(
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
        )
        if is_sticks:
            full = full_stick([each for each in found.pushes if each.axis == push.axis])
            rows[-1].append("{:+.1f} {:+.1f}".format(*full) if full else "-")
    header += ["full stick"] if is_sticks else []
    console.print(make_table("what the vehicle does", header, rows, left_columns=3))
    if found.hover_thrust is not None:
        told = f"hovers at a thrust of {found.hover_thrust:.3f}, trained with"
        console.print(Text(f"{told} {contract.hover_thrust:.3f}"))
    for line in found.missing:
        console.print(Text(f"not measured: {line}", style="yellow"))


def to_json(found: Identification, contract: Contract, config: IdentifyConfig) -> str:
    """Return all results as JSON; a ratio is null if the policy expected no motion."""
    document = {
        "policy": config.flight.policy.policy,
        "action": contract.action,
        "sticks_mapped": config.mapped_sticks,
        "trained_hover_thrust": contract.hover_thrust,
        "hover_thrust": found.hover_thrust,
        "pushes": [asdict(push) | {"ratio": push.ratio} for push in found.pushes],
        "missing": found.missing,
    }
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def identify(config: IdentifyConfig) -> int:
    """Fly the doublet, and print how the vehicle's gains and lags compare with the policy's."""
    clock = MonotonicClock()
    trained = configured_contract(config.flight.policy)
    flight = doublet_flight(config, trained)
    require_writable(config.json, "--json")
    recording = ResponseRecording()
    with empty_folders_removed(*output_folders(flight)):
        check_flight(flight)
        policy, runner = doublet_policy(trained, clock, is_in_air=flight.takeoff is not None)
        plan = plan_flight(flight, runner.contract, is_dual=runner.dual_rate)
        fly_policy(plan, runner, clock=clock, console=flight_console(), sinks=(recording,))
    if policy.program_start_s is None:
        raise PeerError("the flight ended before the doublet began: there is nothing to measure")
    found = identify_pushes(recording, contract=trained, program_start_s=policy.program_start_s)
    if not found.pushes:
        raise PeerError(f"nothing could be measured: {'; '.join(found.missing)}")
    print_identification(found, trained, table_console())
    if config.json is not None:
        write_output(config.json, to_json(found, trained, config), "--json")
    return 0


def doublet_flight(config: IdentifyConfig, trained: Contract) -> FlyConfig:
    """Return the flight of the flags, with the doublet in place of the policy."""
    flight = config.flight
    if flight.link.readonly:
        raise UserError("identify has to move the vehicle: leave out --readonly")
    return replace(
        flight,
        policy=PolicyConfig(policy=f"scripted:doublet:{trained.action}", dual_rate=True),
        camera=replace(flight.camera, camera=("none",), camera_latency=0.0),
        link=replace(flight.link, raw_sticks=not config.mapped_sticks),
        duration=flight.duration or CLIMB_S + doublet_length_s(trained.action),
    )


def doublet_policy(
    trained: Contract, clock: Clock, *, is_in_air: bool
) -> tuple[ScriptedPolicy, PolicyRunner]:
    """Return the doublet in the policy's kind of action, with that policy's gains."""
    names = (
        *("hover_thrust", "full_lean_deg", "full_yaw_rate_degps", "full_climb_mps"),
        *("full_descent_mps", "lean_dead_zone", "yaw_dead_zone", "throttle_dead_zone"),
    )
    policy = ScriptedPolicy(
        "doublet",
        lambda: clock.now_ns() / NS_PER_S,
        action=trained.action,
        starts_in_air=is_in_air,
        contract=Contract(**{name: getattr(trained, name) for name in names}),
    )
    runner = make_numpy_runner(policy, ExecutionSettings(name="scripted:doublet"))
    policy.reset()  # discard the state left by the trial on a dummy sample
    return policy, replace(runner, reset=policy.reset)
