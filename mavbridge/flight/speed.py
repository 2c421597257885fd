"""Check, by times measured before arming, that this computer is fast enough for the policy."""

import math
from typing import NamedTuple

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import PolicyError
from mavbridge.flight.plan import PERIOD_TOLERANCE, FlightPlan, duration_text
from mavbridge.guard.chunks import FreshnessLimits
from policy.contract import Contract
from policy.errors import warned
from policy.loading.request import SolveTimes

CLEARLY = 1.5
"""Factor beyond a limit that counts as out of reach: other programs may have slowed the
measurement."""
NEARLY = 1.1
"""Factor beyond a period that counts as too slow for the rate."""
FASTER = (
    "Use fewer --num-diffusion-steps, a smaller policy, another network.engine or --device, a "
    "faster computer, or a computer that serves the policy (ws://); if it was trained to play each "
    "chunk for longer, set play_s in its contract"
)


class _Age(NamedTuple):
    """Greatest age that an input would reach in flight, and its limit."""

    what: str
    reached_s: float
    allowed_s: float
    by: str = "contract"
    """Origin of the limit."""

    @property
    def share(self) -> float:
        """Ratio of age to limit; 1 is the limit."""
        return self.reached_s / self.allowed_s


def require_speed(plan: FlightPlan, name: str, times: SolveTimes | None) -> tuple[str, ...]:
    """Return notes about the policy's speed and rates, for the user.

    Args:
        plan: plan of the flight.
        name: name of the policy.
        times: measured times of its parts on this computer; None: not measured.

    Raises:
        PolicyError: the policy clearly cannot keep the limits of its own contract.
    """
    contract, is_dual, loops, rates = plan.contract, plan.is_dual, plan.loops, plan.config.rates
    action_hz, image_hz = loops.action_hz, min(plan.image_rates_hz)
    flag = "rates.action" if is_dual else "rates.single"
    notes: list[str] = []
    if is_dual and rates.rate is not None and rates.action_rate is None:
        notes.append(
            warned(f"rates.single={rates.rate:g} applies to a single rate: add --single-rate")
        )
    if not is_dual and rates.action_rate is not None and rates.rate is None:
        told = f"rates.action={rates.action_rate:g} applies to two rates"
        notes.append(warned(f"{told}: use rates.single"))
    if contract.play_s and (rates.action_rate if is_dual else rates.rate) is None:
        notes.append(
            f"{action_hz:.3g} chunks a second, since this policy plays each one for "
            f"{duration_text(contract.play_s)}; {flag} sets another rate"
        )
    if times is None:
        return tuple(notes)
    figures = (
        f"a chunk takes {duration_text(times.act_s)} here, an image {duration_text(times.encode_s)}"
    )
    limits = plan.start_limits
    worst = _worst(contract, limits, times, action_hz=action_hz, image_hz=image_hz)
    told = (
        f"{figures}; at {action_hz:.3g} chunks and {image_hz:.3g} images a second, {worst.what} up "
        f"to {duration_text(worst.reached_s)} old, beyond the {duration_text(worst.allowed_s)} of "
        f"its {worst.by}"
    )
    if worst.share > CLEARLY:
        fastest = _worst(contract, limits, times, action_hz=math.inf, image_hz=math.inf)
        is_by_rate = fastest.share <= CLEARLY
        advice = f"Use a higher {flag} or rates.visual" if is_by_rate else FASTER
        fault = "has too short a horizon" if worst.by == "horizon" else "is too slow"
        raise PolicyError(f"{name} {fault}: {told}. {advice}")
    if worst.share > 1:
        notes.append(warned(f"{told}: it will coast on old chunks"))
    for what, asked_hz, each_s in (
        ("chunks", action_hz, times.act_s),
        ("images", image_hz, times.encode_s),
    ):
        if each_s * asked_hz > NEARLY:
            reached = f"this computer reaches about {1 / each_s:.2g}"
            notes.append(warned(f"{asked_hz:.3g} {what} a second wanted, {reached}: {figures}"))
    return tuple(notes)


def _worst(
    contract: Contract,
    limits: FreshnessLimits,
    times: SolveTimes,
    *,
    action_hz: float,
    image_hz: float,
) -> _Age:
    """Return the age that comes nearest to its limit, when the last stick of a chunk leaves.

    That is just before the next chunk. The camera's own latency is unknown here and not included.
    """
    played = limits.while_played(round(contract.play_s * NS_PER_S))
    every_s = max(1 / action_hz, times.act_s)
    state_s = times.act_s + every_s
    image_s = times.encode_s + max(1 / image_hz, times.encode_s)
    sent, horizon_s = "when a stick leaves, ", contract.horizon * contract.chunk_dt_s
    # A single action is held for its step from its arrival.
    chunk_s = every_s * (1 - PERIOD_TOLERANCE) if contract.horizon == 1 else state_s
    ages = (
        _Age(f"{sent}the attitude is", state_s, played.state_ns / NS_PER_S),
        _Age(f"{sent}the velocity is", state_s, played.velocity_ns / NS_PER_S),
        _Age(f"{sent}the chunk is", every_s, played.chunk_ns / NS_PER_S),
        _Age(f"{sent}the start of its chunk is", chunk_s, horizon_s, "horizon"),
        _Age("when a chunk is begun, the image is", image_s, limits.feature_ns / NS_PER_S),
        _Age(f"{sent}the image is", image_s + state_s, played.feature_ns / NS_PER_S),
    )
    return max(ages, key=lambda age: age.share)
