"""Measured gains and lags beside those of training: table, words, JSON."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict

from rich.console import Console
from rich.text import Text

from mavbridge.commands.identify.analysis import Identification, PushResult, Side, full_stick
from mavbridge.commands.identify.axes import SIMULATOR_TIME_63_S
from mavbridge.commands.output import make_table
from policy.contract import Contract
from policy.scripted.programs import Axis

ALIKE = 0.1
"""Gains that differ by less, of the trained one, are called the same."""
SLOWER = 1.5
"""A response that takes so many times as long as the simulator's is called slower."""
TRAINED, COMMANDED = "the policy was trained with", "was commanded"
AXES: tuple[Axis, ...] = ("roll", "pitch", "yaw", "climb")


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
