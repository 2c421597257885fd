"""Inputs of a policy beside image and state, defined once for flight and training.

The 100 Hz loop evaluates it for one tick (``mavbridge.flight.history`` and ``ego_motion``),
training for a batch (``policy.data.samples``); a test checks that both agree.
"""

from collections.abc import Sequence

from policy.rotation import Q, V, conjugate, multiply, rotate, rotation_vector

NS_PER_S = 1_000_000_000


def history_ages_ns(length: int, dt_s: float) -> Sequence[int]:
    """Ages of the sticks in a history, oldest first; the newest is ``dt_s`` before the tick.

    A stick holds until the next one is sent, so the one at a time is the newest sent by then.
    Released sticks, and those before the first was sent, are neutral.
    """
    dt_ns = round(dt_s * NS_PER_S)
    return range(length * dt_ns, 0, -dt_ns)


def motion_since_exposure(
    attitude_then: Q, attitude_now: Q, velocity_change_world: V
) -> tuple[V, V]:
    """Rotation vector (rad) and change of velocity (m/s) in the body axes at the exposure.

    Between two readings, the body turns at a constant rate and accelerates evenly; outside of all
    readings it does neither.
    """
    body_from_world = conjugate(attitude_then)
    turn: V = rotation_vector(multiply(body_from_world, attitude_now))
    return turn, rotate(body_from_world, velocity_change_world)
