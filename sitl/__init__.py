"""Simulated flight controller, a separate process reached over MAVLink and shared memory.

It shares no code with the bridge, so an agreement between the two is an agreement over the wire.
"""


class UsageError(Exception):
    """Unusable flag, address or port; the message says the reason and gives an alternative."""
