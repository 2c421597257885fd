"""Everything that follows from a flight's flags and contract, resolved once."""

import math
from dataclasses import asdict, dataclass

from mavbridge.config.flight import FlyConfig
from mavbridge.config.policy import LoopRates
from mavbridge.core.clock import NS_PER_S, period_ns
from mavbridge.core.errors import PolicyError
from mavbridge.flight.settings import (
    AGES,
    TAU_S,
    action_limits,
    action_meaning,
    effective_freshness,
    engagement_settings,
    envelope_limits,
    require_goal,
)
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.guard.limits import Smoothing
from mavbridge.guard.values import FlightSettings
from policy.contract import Contract

PERIOD_TOLERANCE = 0.01
"""Fraction by which a horizon may be shorter than the chunk period: 0.033 s for 30 Hz."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightPlan:
    """Resolved settings of a flight, made by ``plan_flight`` and handed down."""

    config: FlyConfig
    contract: Contract
    is_dual: bool
    loops: LoopRates
    start_limits: FreshnessLimits
    """Maximum age of each input from which a chunk may be computed."""
    guard: FlightSettings
    """Settings of the guard. Its ``freshness`` applies while a chunk is played."""

    @property
    def image_rates_hz(self) -> tuple[float, ...]:
        """Images encoded per second of each camera, in the contract's order."""
        most_hz, cameras = self.loops.vision_hz, self.contract.cameras
        rates_hz = self.contract.camera_rates_hz or (most_hz,) * len(cameras)
        return tuple(min(most_hz, rate_hz) for rate_hz in rates_hz)

    def figures(self) -> dict[str, float]:
        """Return rates, periods and limits by name, for ``check`` and ``meta.json``."""
        ages_ns, envelope = self.guard.freshness, asdict(self.guard.envelope)
        return {
            "vision_hz": self.loops.vision_hz,
            "action_hz": self.loops.action_hz,
            "stick_hz": self.config.rates.stick_rate,
            "state_hz": self.loops.state_hz,
            **{f"{flag}_s": getattr(ages_ns, age) / NS_PER_S for age, (_, flag) in AGES.items()},
            "tau_s": self.guard.smoothing.tau_s,
            **{f"max_{quantity}": limit for quantity, limit in envelope.items()},
        }


def plan_flight(config: FlyConfig, contract: Contract, *, is_dual: bool) -> FlightPlan:
    """Resolve the flags of a flight against the policy's contract.

    Raises:
        UserError: a flag contradicts the contract.
        PolicyError: a chunk ends before the next one is due.
    """
    rates, limits = config.rates, config.limits
    loops = rates.loops(is_dual=is_dual, play_s=contract.play_s)
    start_limits = effective_freshness(contract, limits)
    require_goal(config, contract)
    _require_horizon(contract, loops.action_hz, "rates.action" if is_dual else "rates.single")
    guard = FlightSettings(
        stick_period_ns=period_ns(rates.stick_rate),
        chunk_period_ns=period_ns(loops.action_hz),
        freshness=start_limits.while_played(round(contract.play_s * NS_PER_S)),
        meaning=action_meaning(contract, config.link),
        output=None if config.link.output == "auto" else config.link.output,
        smoothing=Smoothing(
            limits=action_limits(config, contract.action),
            tau_s=TAU_S[contract.action] if limits.tau is None else limits.tau,
        ),
        envelope=envelope_limits(config.envelope, contract),
        engagement=engagement_settings(config, contract),
        watches_home_height="height" in contract.state_extras,
        watches_position=bool({"goal", "altitude"} & set(contract.state_extras)),
    )
    return FlightPlan(
        config=config,
        contract=contract,
        is_dual=is_dual,
        loops=loops,
        start_limits=start_limits,
        guard=guard,
    )


def _require_horizon(contract: Contract, action_hz: float, flag: str) -> None:
    horizon_s = contract.horizon * contract.chunk_dt_s
    if horizon_s < (1 - PERIOD_TOLERANCE) / action_hz:
        least_hz = math.ceil(1 / horizon_s - 1e-6)
        raise PolicyError(
            f"the policy has a horizon of {duration_text(horizon_s)} ({contract.horizon} x "
            f"{duration_text(contract.chunk_dt_s)}), shorter than the "
            f"{duration_text(1 / action_hz)} between two solves at {action_hz:.3g} chunks a "
            f"second: use {flag} {least_hz} or more, or correct horizon and chunk_dt_s in its "
            "contract"
        )


def duration_text(duration_s: float) -> str:
    """Return a duration in s or ms, for a message."""
    if duration_s >= 1:
        return f"{duration_s:.3g} s"
    return f"{duration_s * 1e3:.{0 if duration_s >= 0.01 else 1}f} ms"
