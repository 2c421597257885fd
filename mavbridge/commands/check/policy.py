"""Rows about the policy: whether it loads, its engine, its speed here, and what it expects."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field

from mavbridge.commands.check.rows import Row, Verdict
from mavbridge.config.flight import FlyConfig
from mavbridge.core.clock import Clock
from mavbridge.core.errors import MavbridgeError
from mavbridge.flight.plan import plan_flight
from mavbridge.flight.policies import load_configured_policy
from mavbridge.flight.speed import require_speed
from policy.contract import Contract
from policy.loading.request import LoadedPolicy
from policy.protocol import Executable

NO_POLICY = "none"
_BUSY = 0.8
"""Share of a slot from which other work on this computer makes chunks late."""


@dataclass(frozen=True, kw_only=True)
class PolicyFindings:
    """The policy's rows, and what the rest of the check takes from it."""

    rows: list[Row] = field(default_factory=list)
    contract: Contract | None = None
    """None: no policy was named, or it cannot be loaded."""
    is_dual: bool = True


def check_policy(config: FlyConfig, clock: Clock) -> PolicyFindings:
    """Load the policy as a flight does, and close it again; a failure is a row."""
    if config.policy.policy == NO_POLICY:
        return PolicyFindings()
    try:
        with ExitStack() as stack:
            loaded = load_configured_policy(
                config.policy, clock, starts_in_air=config.takeoff is not None
            )
            stack.enter_context(loaded)
            rows = [_engine_row(loaded), *_speed_rows(config, loaded)]
            rows += _contract_rows(config, loaded.executable)
            contract = loaded.executable.contract
            return PolicyFindings(rows=rows, contract=contract, is_dual=loaded.executable.dual_rate)
    except MavbridgeError as error:
        return PolicyFindings(rows=[_row("policy", config.policy.policy, "no-go", str(error))])


def _engine_row(loaded: LoadedPolicy) -> Row:
    """The engine and its agreement with torch; what is not as it was asked for is a warning."""
    executable = loaded.executable
    warnings = [note for note in loaded.notes if note.startswith("warning:")]
    agrees = any("agrees with torch" in note for note in loaded.notes)
    found = f"{executable.name} on {executable.engine}{', agrees with torch' if agrees else ''}"
    return _row(
        "engine",
        found,
        "warn" if warnings else "go",
        "; ".join(note.removeprefix("warning: ") for note in warnings),
        expected="the fastest that agrees with torch",
    )


def _speed_rows(config: FlyConfig, loaded: LoadedPolicy) -> Iterator[Row]:
    """The share of each slot that a chunk and an image need, and what a flight says of it."""
    yield from _slot_rows(config, loaded)
    expected = "within the ages of its contract"
    try:
        executable = loaded.executable
        plan = plan_flight(config, executable.contract, is_dual=executable.dual_rate)
        notes = require_speed(plan, executable.name, loaded.times)
    except MavbridgeError as error:
        yield _row("speed", "too slow", "no-go", str(error), expected=expected)
        return
    warnings = [note.removeprefix("warning: ") for note in notes if note.startswith("warning:")]
    if warnings:
        yield _row("speed", "slower than asked", "warn", "; ".join(warnings), expected=expected)


def _slot_rows(config: FlyConfig, loaded: LoadedPolicy) -> Iterator[Row]:
    contract, times = loaded.executable.contract, loaded.times
    if times is None:
        yield _row("speed", "not measured: no chunk on a dummy sample")
        return
    loops = config.rates.loops(is_dual=loaded.executable.dual_rate, play_s=contract.play_s)
    image_hz = min((loops.max_vision_hz, *contract.camera_rates_hz))
    for name, each_s, rate_hz in (
        ("a chunk", times.act_s, loops.action_hz),
        ("an image", times.encode_s, image_hz),
    ):
        share = each_s * rate_hz
        is_tight = share > _BUSY
        yield _row(
            f"time for {name}",
            f"{each_s * 1000:.1f} ms, {share:.0%} of its slot",
            "warn" if is_tight else "go",
            f"{name} leaves little of its slot: other programs will make it late"
            if is_tight
            else "",
            expected=f"under {_BUSY:.0%} of {1000 / rate_hz:.3g} ms ({rate_hz:.3g} Hz)",
        )


def _contract_rows(config: FlyConfig, executable: Executable) -> list[Row]:
    contract = executable.contract
    takes = f"{contract.image_width}x{contract.image_height} of {', '.join(contract.cameras)}"
    found = f"{contract.action}, {contract.state_frame}, {takes}"
    try:
        plan = plan_flight(config, contract, is_dual=executable.dual_rate)
    except MavbridgeError as error:
        return [_row("flags of the flight", found, "no-go", str(error))]
    figures = ", ".join(f"{name} {value:.4g}" for name, value in plan.figures().items())
    return [
        _row("contract", found, expected="no flag that contradicts it"),
        _row("plan", figures),
    ]


def _row(
    name: str, found: str, verdict: Verdict = "go", advice: str = "", *, expected: str = ""
) -> Row:
    return Row(
        area="policy", name=name, found=found, expected=expected, verdict=verdict, advice=advice
    )
