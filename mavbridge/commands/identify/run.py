"""The command: a usual flight whose policy is the scripted doublet, then what was measured."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace

from rich.console import Console
from rich.text import Text

from mavbridge.commands.config import IdentifyConfig
from mavbridge.commands.identify.analysis import (
    SIMULATOR_TIME_63_S,
    Identification,
    PushResult,
    Side,
    full_stick,
    identify_pushes,
)
from mavbridge.commands.identify.fit import ResponseRecording
from mavbridge.commands.output import make_table, table_console
from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import PolicyConfig
from mavbridge.core.clock import NS_PER_S, Clock, MonotonicClock
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.files import require_writable
from mavbridge.flight.app import fly_executable
from mavbridge.flight.checks import check_flight
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import configured_contract
from mavbridge.observe.output import flight_console
from policy.contract import Contract
from policy.engines.executable import ExecutionSettings, make_numpy_executable
from policy.protocol import Executable
from policy.scripted import ScriptedPolicy
from policy.scripted.programs import Axis, doublet_length_s

ALIKE = 0.1
"""Gains that differ by less, of the trained one, are called the same."""
SLOWER = 1.5
"""A response that takes so many times as long as the simulator's is called slower."""
TRAINED, COMMANDED = "the policy was trained with", "was commanded"
AXES: tuple[Axis, ...] = ("roll", "pitch", "yaw", "climb")
CLIMB_S = 20.0
"""From the first action to the begin of the doublet, takeoff included."""


def print_identification(found: Identification, contract: Contract, console: Console) -> None:
    """Print every push, a verdict for each axis, and what could not be measured."""
    is_sticks = contract.action == "sticks"
    header = (
        *("axis", "stick" if is_sticks else "commanded", "motion", "measured"),
        "trained with" if is_sticks else "expected",
        *("ratio", "dead time", "63 %"),
    )
    rows = [_row(push, is_sticks=is_sticks) for push in found.pushes]
    console.print(make_table("what the vehicle does", header, rows, left_columns=3))
    for line in verdicts(found, contract):
        console.print(Text(line))
    for line in found.missing:
        console.print(Text(f"not measured: {line}", style="yellow"))


def _row(push: PushResult, *, is_sticks: bool) -> tuple[str, ...]:
    amount = f"{push.up.amount:.0%}" if is_sticks else f"{push.up.amount:.2f}"
    return (
        *(push.axis, amount, f"{push.motion}, {push.unit}"),
        f"{push.up.reached:+.2f} {push.down.reached:+.2f}",
        f"{push.up.trained:+.2f} {push.down.trained:+.2f}",
        f"{push.up.ratio:.2f} {push.down.ratio:.2f}",
        *(f"{1e3 * push.dead_time_s:.0f} ms", f"{1e3 * push.time_63_s:.0f} ms"),
    )


def verdicts(found: Identification, contract: Contract) -> Iterator[str]:
    """A sentence for each axis, and one for the thrust that hovers."""
    for axis in AXES:
        pushes = [push for push in found.pushes if push.axis == axis]
        if not pushes:
            continue
        if axis == "climb":
            yield f"climb: {_gain([push.up for push in pushes], pushes, contract)}"
            yield f"descent: {_gain([push.down for push in pushes], pushes, contract)}"
        else:
            yield f"{axis}: {_gain([push.up for push in pushes], pushes, contract)}"
        yield f"{axis}: {_lag(pushes[-1], contract)}"
    if found.hover_thrust is not None:
        ratio = found.hover_thrust / contract.hover_thrust
        yield f"thrust: hovers at {found.hover_thrust:.3f}, {_compared(ratio, TRAINED)}"


def _gain(sides: Sequence[Side], pushes: Sequence[PushResult], contract: Contract) -> str:
    """Words for the larger push, and for the smaller one where that is another story."""
    large = sides[-1].ratio
    text = _compared(large, TRAINED if contract.action == "sticks" else COMMANDED)
    is_curved = abs(math.log(max(sides[0].ratio, 1e-3) / max(large, 1e-3))) > ALIKE
    if is_curved:
        text += f" (at {_amount(sides[0], contract)} {sides[0].ratio:.1f} times)"
    full = full_stick(pushes, contract, is_up=sides[-1].amount > 0.0)
    if contract.action == "sticks" and full is not None:
        text += f"; full stick {abs(full.reached):.1f} of {abs(full.trained):.1f} {pushes[0].unit}"
        if not is_curved:
            text += f", dead zone {full.dead_zone:.0%}"
    return text


def _amount(side: Side, contract: Contract) -> str:
    return f"{abs(side.amount):.0%}" if contract.action == "sticks" else f"{abs(side.amount):.2f}"


def _compared(ratio: float, expected: str) -> str:
    return f"as {expected}" if abs(ratio - 1.0) < ALIKE else f"{ratio:.1f} times what {expected}"


def _lag(push: PushResult, contract: Contract) -> str:
    text = f"63 % after {1e3 * push.time_63_s:.0f} ms, {1e3 * push.dead_time_s:.0f} of them dead"
    known_s = SIMULATOR_TIME_63_S[contract.action].get(push.axis)
    if known_s is None:
        return text
    ratio = push.time_63_s / known_s
    if 1 / SLOWER < ratio < SLOWER:
        return f"{text}; the bundled simulator's {1e3 * known_s:.0f} ms are about the same"
    word = "slower" if ratio > 1.0 else "faster"
    return f"{text}; {word} than the bundled simulator's {1e3 * known_s:.0f} ms"


def to_json(found: Identification, contract: Contract, *, policy: str, is_mapped: bool) -> str:
    """Everything as JSON."""
    pushes = [
        asdict(push) | {"ratio_up": _finite(push.up.ratio), "ratio_down": _finite(push.down.ratio)}
        for push in found.pushes
    ]
    document = {
        "policy": policy,
        "action": contract.action,
        "sticks_mapped": is_mapped,
        "trained_hover_thrust": contract.hover_thrust,
        "hover_thrust": found.hover_thrust,
        "pushes": pushes,
        "missing": list(found.missing),
        "verdicts": list(verdicts(found, contract)),
    }
    return json.dumps(document, indent=2, allow_nan=False) + "\n"


def _finite(ratio: float) -> float | None:
    """The ratio; None where the policy expected no motion at all."""
    return ratio if math.isfinite(ratio) else None


def identify(config: IdentifyConfig) -> int:
    """Fly the doublet, and say how the vehicle's gains and lags compare with the policy's.

    Raises:
        MavbridgeError: as for a flight; or it ended before anything could be measured.
    """
    clock = MonotonicClock()
    trained = configured_contract(config.flight.policy)
    flight = doublet_flight(config, trained)
    require_writable(config.json, "--json")
    check_flight(flight)
    policy, executable = doublet_policy(trained, clock, is_in_air=flight.takeoff is not None)
    recording = ResponseRecording()
    plan = plan_flight(flight, executable.contract, is_dual=executable.dual_rate)
    fly_executable(plan, executable, clock=clock, console=flight_console(), sinks=(recording,))
    if policy.program_start_s is None:
        raise PeerError("the flight ended before the doublet began: there is nothing to measure")
    found = identify_pushes(recording, contract=trained, program_start_s=policy.program_start_s)
    if not found.pushes:
        raise PeerError(f"nothing could be measured: {'; '.join(found.missing)}")
    print_identification(found, trained, table_console())
    if config.json is not None:
        text = to_json(
            found, trained, policy=config.flight.policy.policy, is_mapped=config.mapped_sticks
        )
        config.json.write_text(text)
    return 0


def doublet_flight(config: IdentifyConfig, trained: Contract) -> FlyConfig:
    """The flight that the flags ask for, with the doublet instead of the policy.

    Raises:
        UserError: ``--readonly`` was given.
    """
    flight = config.flight
    if flight.link.readonly:
        raise UserError("identify has to move the vehicle: leave out --readonly")
    return replace(
        flight,
        policy=PolicyConfig(policy=f"scripted:doublet:{trained.action}", dual_rate=True),
        camera=replace(flight.camera, camera=("none",), window_name=None, camera_latency=0.0),
        link=replace(flight.link, raw_sticks=not config.mapped_sticks),
        duration=flight.duration or CLIMB_S + doublet_length_s(trained.action),
    )


def doublet_policy(
    trained: Contract, clock: Clock, *, is_in_air: bool
) -> tuple[ScriptedPolicy, Executable]:
    """The doublet in the policy's kind of action, and with what that policy means by it."""
    policy = ScriptedPolicy(
        "doublet",
        lambda: clock.now_ns() / NS_PER_S,
        action=trained.action,
        starts_in_air=is_in_air,
        contract=Contract(
            hover_thrust=trained.hover_thrust,
            full_lean_deg=trained.full_lean_deg,
            full_yaw_rate_degps=trained.full_yaw_rate_degps,
            full_climb_mps=trained.full_climb_mps,
            full_descent_mps=trained.full_descent_mps,
            lean_dead_zone=trained.lean_dead_zone,
            yaw_dead_zone=trained.yaw_dead_zone,
            throttle_dead_zone=trained.throttle_dead_zone,
        ),
    )
    executable = make_numpy_executable(policy, ExecutionSettings(name="scripted:doublet"))
    policy.reset()  # of what the trial on a dummy sample left behind
    return policy, replace(executable, reset=policy.reset)
