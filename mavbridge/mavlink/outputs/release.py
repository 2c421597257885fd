"""When releases are sent after the last action, and that none is lost with the connection."""

from mavbridge.core.clock import NS_PER_MS

RELEASE_SPACING_NS = 50 * NS_PER_MS


class ReleasePlan:
    """Releases that are due; asked for as often as the caller likes."""

    def __init__(self) -> None:
        self.left = 0
        self.is_owed = False
        """One could not be sent: it goes before every other packet."""
        self._due_ns = 0

    def acted(self, releases: int) -> None:
        """Note an action, after which so many releases may follow; call it before the send, as the
        action may leave whatever that says."""
        self.left, self._due_ns = releases, 0

    def is_due(self, now_ns: int) -> bool:
        """One should be sent now, if the sticks are to be released."""
        return self.left > 0 and now_ns >= self._due_ns

    def tried(self, now_ns: int, *, is_sent: bool) -> None:
        """Note whether one has left."""
        self.is_owed = not is_sent
        if is_sent:
            self.left -= 1
            self._due_ns = now_ns + RELEASE_SPACING_NS
