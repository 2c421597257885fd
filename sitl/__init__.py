"""A flight controller to test against: its own process, reached over MAVLink and shared memory.

Nothing here comes from the bridge, so an agreement between the two is an agreement over the wire.
"""
