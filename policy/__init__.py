"""Vision policies: networks, how they run, train and are stored; ``policy.contract`` is the way in.

Nothing here speaks MAVLink or reads a clock of its own. A policy, file or flight that cannot be
used raises a ``policy.errors.PolicyError`` or one of its kinds; its message says what to do.
"""
