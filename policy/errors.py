"""The root of every expected error, and those of policies; ``mavbridge.core.errors`` has the rest.

It lies here because ``policy`` imports nothing of ``mavbridge``.
"""


class MavbridgeError(Exception):
    """Base of all expected errors; printed without a traceback."""


class PolicyError(MavbridgeError):
    """A policy, contract, checkpoint or dataset that cannot be used; says what to do."""


class ContractError(PolicyError):
    """A contract that is malformed or that the bridge cannot keep."""


class CheckpointError(PolicyError):
    """A checkpoint that cannot be read, or does not fit; the message says what to do."""
