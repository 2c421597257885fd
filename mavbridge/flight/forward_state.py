"""Telemetry predicted to the time at which the next chunk will act, for slow policies."""

import math
from collections.abc import Callable

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.vehicle import Action, Reading, Telemetry
from policy.motion.forward_motion import ForwardMotion, VehicleMotion

STEP_NS = 10 * NS_PER_MS
"""Step of the prediction."""
LEAST_SPEED_MPS = 0.3
"""A slower vehicle may stand on the ground, where the model would let it fall."""


def rolled_forward(
    model: ForwardMotion, telemetry: Telemetry, until_ns: int, flown_at: Callable[[int], Action]
) -> Telemetry:
    """Return the telemetry at ``until_ns``; as it is for a vehicle that stands still.

    Each reading is predicted from the attitude's time, and counts as measured at ``until_ns``.
    Positions and heights move with the velocity.

    ``flown_at`` returns the action that the vehicle flies at a time [ns]: sent already, or planned.
    """
    attitude, rate, velocity, force = telemetry.motion
    if attitude is None or rate is None or velocity is None or force is None:
        return telemetry
    now_ns = attitude.happened_ns
    steps = max(round((until_ns - now_ns) / STEP_NS), 1)
    dt_ns = (until_ns - now_ns) // steps
    if dt_ns <= 0 or math.hypot(*velocity.values) < LEAST_SPEED_MPS:
        return telemetry
    w, x, y, z = attitude.values
    start = VehicleMotion((w, x, y, z), _three(rate), _three(velocity), _three(force))
    actions = [flown_at(now_ns + step * dt_ns) for step in range(steps)]
    end = model.after(start, actions, dt_ns / NS_PER_S)
    half_s = (until_ns - now_ns) / NS_PER_S / 2
    north, east, down = (
        half_s * (v + u) for v, u in zip(start.velocity_ned_mps, end.velocity_ned_mps, strict=True)
    )
    return Telemetry(
        Reading(until_ns, end.ned_from_body_wxyz),
        Reading(until_ns, end.rate_body_radps),
        Reading(until_ns, end.velocity_ned_mps),
        Reading(until_ns, end.specific_force_body_mps2),
        position_ned_m=_moved(telemetry.position_ned_m, (north, east, down), until_ns),
        height_above_home_m=_moved(telemetry.height_above_home_m, (-down,), until_ns),
    )


def _three(reading: Reading) -> tuple[float, float, float]:
    x, y, z = reading.values
    return x, y, z


def _moved(reading: Reading | None, by: tuple[float, ...], at_ns: int) -> Reading | None:
    if reading is None:
        return None
    return Reading(at_ns, tuple(a + b for a, b in zip(reading.values, by, strict=True)))
