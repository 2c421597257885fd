"""Echo check: compares the sticks that we send with those that the vehicle reports."""

from collections import deque

from mavbridge.core.clock import NS_PER_S
from mavbridge.mavlink.codec.calibration import Pwm

ECHO_DEADLINE_NS = NS_PER_S
"""An override shows up in RC_CHANNELS within about 14 ms; a second allows for a slow link."""
NUDGE_US = 4
"""Added to the roll channel until the echo is seen; the usual dead zone is 20 us."""
_RETRY_NS = 3 * NS_PER_S


class EchoCheck:
    """Compares the stick channels of RC_CHANNELS with the overrides of the last second.

    Confirmed when the vehicle reports values that we sent and that it did not report before we
    sent any; failed when it reports none within a second of sending.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Pwm]] = deque()
        self._baseline: Pwm | None = None
        self._since_ns: int | None = None
        self._failed_ns: int | None = None
        self._confirmed_ns: int | None = None

    @property
    def confirmed(self) -> bool:
        """The vehicle acts on our sticks."""
        return self._confirmed_ns is not None

    def with_nudge(self, pwm_us: Pwm) -> Pwm:
        """The values to send: until confirmed, they differ from what the vehicle reported before.

        A vehicle that ignores us while its receiver's sticks rest where ours do would otherwise
        pass the check.
        """
        if self.confirmed or pwm_us != self._baseline:
            return pwm_us
        throttle, yaw, pitch, roll = pwm_us
        return throttle, yaw, pitch, roll + NUDGE_US

    def sent(self, pwm_us: Pwm, now_ns: int) -> None:
        """Note an override that was sent."""
        if self._since_ns is None:
            self._since_ns = now_ns
        self._sent.append((now_ns, pwm_us))
        while self._sent[0][0] < now_ns - ECHO_DEADLINE_NS:
            self._sent.popleft()

    def released(self) -> None:
        """Overriding has ended: the next one starts a new check."""
        self._sent.clear()
        self._since_ns = None
        self._confirmed_ns = None

    def received(self, pwm_us: Pwm, now_ns: int) -> None:
        """Compare one RC_CHANNELS."""
        if self._since_ns is None:
            self._baseline = pwm_us
            return
        is_conclusive = self.confirmed or pwm_us != self._baseline
        if is_conclusive and any(pwm_us == past for _, past in self._sent):
            self._confirmed_ns = now_ns
            self._failed_ns = None

    def failed(self, now_ns: int) -> bool:
        """No echo within the deadline; stays true for 3 s after sending has stopped."""
        if self._since_ns is not None:
            newest_ns = max(self._since_ns, self._confirmed_ns or 0)
            if now_ns - newest_ns > ECHO_DEADLINE_NS:
                self._failed_ns = now_ns
        return self._failed_ns is not None and now_ns - self._failed_ns < _RETRY_NS
