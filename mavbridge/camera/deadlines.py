"""Waiting times that all sources share."""

from mavbridge.core.clock import NS_PER_S, Clock

FIRST_FRAME_NS = 10 * NS_PER_S
"""Limit for the first frame: exposure control, stream negotiation, a writer that starts later."""
STALL_NS = 2 * NS_PER_S
"""Limit for every other frame."""


def wait_until_due(clock: Clock, due_ns: int, timeout_ns: int) -> bool:
    """Sleep until ``due_ns``, but no longer than the timeout; True if that time has come."""
    deadline_ns = clock.now_ns() + timeout_ns
    clock.sleep_until_ns(min(due_ns, deadline_ns))
    return due_ns <= deadline_ns
