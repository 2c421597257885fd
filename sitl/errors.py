"""What a user can get wrong, as one exception."""


class UsageError(Exception):
    """A flag, address or port that cannot be used; the message says why and what would do."""
