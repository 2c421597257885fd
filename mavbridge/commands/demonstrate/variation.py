"""The random part of a demonstration: conditions, delays, start and disturbance."""

from dataclasses import dataclass

import numpy as np

from mavbridge.core.clock import NS_PER_MS
from mavbridge.simulation.delays import Delay, Delays
from sitl.vehicle.conditions import NOMINAL, Conditions, random_conditions

NOMINAL_SHARE = 0.25
"""Flights without random conditions: what most users fly first."""
AIRBORNE_SHARE = 0.35
"""Flights that start in the air and off the course."""
UNDISTURBED_SHARE = 0.3
"""Flights without disturbed sticks: examples of a good flight."""


@dataclass(frozen=True, kw_only=True)
class Variation:
    """The random part of one demonstration; everything follows from ``seed``."""

    seed: int
    conditions: Conditions
    delays: Delays
    starts_airborne: bool
    disturbance: float


def draw_variation(seed: int) -> Variation:
    """The variation of a seed."""
    random = np.random.Generator(np.random.PCG64((seed, 4)))
    shares = (NOMINAL_SHARE, AIRBORNE_SHARE, UNDISTURBED_SHARE)
    is_nominal, is_airborne, is_undisturbed = random.random(3) < shares
    return Variation(
        seed=seed,
        conditions=NOMINAL if is_nominal else random_conditions(seed),
        delays=_random_delays(random),
        starts_airborne=bool(is_airborne),
        disturbance=0.0 if is_undisturbed else float(random.uniform(0.5, 1.0)),
    )


def _random_delays(random: np.random.Generator) -> Delays:
    """Delays between those of a fast computer and a busy one, with log-uniform medians."""

    def median_ns(low_ms: float, high_ms: float) -> int:
        return round(NS_PER_MS * float(np.exp(random.uniform(np.log(low_ms), np.log(high_ms)))))

    camera_ns, vision_ns = median_ns(2, 12), median_ns(6, 35)
    action_ns, link_ns = median_ns(0.8, 6), median_ns(0.2, 3)
    return Delays(
        camera=Delay(p50_ns=camera_ns),
        vision=Delay(p50_ns=vision_ns, p99_ns=2 * vision_ns),
        action=Delay(p50_ns=action_ns, p99_ns=2 * action_ns),
        uplink=Delay(p50_ns=link_ns),
        downlink=Delay(p50_ns=link_ns),
    )
