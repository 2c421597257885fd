"""When releases are sent after the last override, and that none is lost with the connection."""

from mavbridge.core.clock import NS_PER_MS
from mavbridge.mavlink.codec.calibration import RcCalibration

RELEASE_SPACING_NS = 50 * NS_PER_MS
MOST_RELEASES = 80
"""Releases after the last override: over the four seconds for which they are asked for at most;
then silence, so that another station may override."""


class ReleasePlan:
    """Releases that are due; asked for as often as the caller likes."""

    def __init__(self) -> None:
        self.calibration: RcCalibration | None = None
        """Calibration of the last override, for its release even after a reboot of the vehicle."""
        self.left = 0
        self.is_owed = False
        """One could not be sent: it goes before every other packet."""
        self._due_ns = 0

    def overridden(self, calibration: RcCalibration) -> None:
        """Note an override; call it before the send, as it may leave whatever that says."""
        self.calibration, self.left, self._due_ns = calibration, MOST_RELEASES, 0

    def is_due(self, now_ns: int) -> bool:
        """One should be sent now, if the sticks are to be released."""
        return self.left > 0 and now_ns >= self._due_ns

    def tried(self, now_ns: int, *, is_sent: bool) -> None:
        """Note whether one has left."""
        self.is_owed = not is_sent
        if is_sent:
            self.left -= 1
            self._due_ns = now_ns + RELEASE_SPACING_NS
