"""Vision policies: networks, engines, training and checkpoints. Start at ``policy.contract``.

Nothing here speaks MAVLink or reads a clock other than an injected one. A policy, file or flight
that cannot be used raises a ``policy.errors.PolicyError`` or a subclass; the message names the next
step.
"""
