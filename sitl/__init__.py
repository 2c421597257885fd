"""A flight controller to test against: its own process, reached over MAVLink and shared memory.

Nothing here comes from the bridge, so an agreement between the two is an agreement over the wire.
"""


class UsageError(Exception):
    """A flag, address or port that cannot be used; the message says why and what would work."""
