"""The one exception for what a user got wrong."""


class UsageError(Exception):
    """A flag, address or port that cannot be used; the message says why and what would work."""
