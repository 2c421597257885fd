"""Vision policies: networks, how they run, train and are stored; ``policy.contract`` is the way in.

Nothing here speaks MAVLink or reads a clock of its own.
"""
