"""Echo check: compares the sticks that we send with those that the vehicle shows in RC_CHANNELS."""

from collections import deque
from typing import Literal, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.calibration import Pwm

EchoFault: TypeAlias = Literal["unseen", "foreign", "returned", "silent"]
"""unseen: no echo since the first override, or no RC_CHANNELS at all. foreign: sticks that neither
we nor the pilot's receiver sent. returned: the sticks that it showed before us. silent: our sticks,
but always the same ones, although we keep changing them."""

CONFIRM_NS = NS_PER_S
"""Longest wait for the first echo, and longest pause of RC_CHANNELS: an override is shown after
about 14 ms; 200 ms of delay each way and a few lost packets still leave half of this."""
MATCH_NS = 700 * NS_PER_MS
"""Oldest of our sticks that may still be shown: 200 ms of delay each way, a value that is held
through five lost packets at 30 Hz, an interval of RC_CHANNELS, and a reserve."""
TOLERANCE_US = 2
"""Movement of a receiver at rest. The vehicle itself shows overrides to the microsecond."""
SILENT_US = 400_000
"""Longest time that the echo may be constant, by the vehicle's clock. We send another value every
25 ms, so that 20 % of loss in both directions leaves a dozen changes in this time."""
SILENT_SAMPLES = 8
"""Fewest RC_CHANNELS in that time, as many as come at 20 Hz: where some are lost, a few of them
may be equal by chance."""
RETURNED_US = 500_000
RETURNED_SAMPLES = 2
"""So many RC_CHANNELS within this time with the sticks of before us: one is a stray release of
another station; a joystick at 50 Hz has a quarter to a half of the 29. Sticks that nobody but
another overrider can have sent need no second one: at 10 Hz it is shown but once or twice."""
NUDGE_US = 1
"""Steps of the roll channel in flight: 1500, 1501 and 1502 us were seen to move nothing, inside the
dead zone of 20 us; beyond it, 2 us are 0.2 degrees of lean at the usual calibration."""
SEEK_NUDGE_US = 4
"""Steps until the first echo: more than a receiver at rest moves, so that it is not taken for us.
Two of them are well inside the dead zone."""
NUDGE_STEP_NS = 25 * NS_PER_MS
_NUDGE_LEVELS = 3
"""Three levels of 25 ms, by time and not by packet: no usual rate of RC_CHANNELS or of sticks hits
the same level each time, and one lost packet never makes two levels look like one."""
_PAUSE_NS = 100 * NS_PER_MS
"""After this long without a stick of ours, an echo may rightly have been constant."""
_RETRY_NS = 3 * NS_PER_S
"""A fault stays known for this long after it was last seen."""
_MIDDLE_US = 1500


def _is_near(one: Pwm, other: Pwm) -> bool:
    return one == other or all(abs(a - b) <= TOLERANCE_US for a, b in zip(one, other, strict=True))


class EchoCheck:
    """Tells whether the vehicle acts on our sticks, on ours alone, and on fresh ones.

    Confirmed when it shows sticks that we sent and that it did not show before. From then on each
    RC_CHANNELS must match something that we sent recently, and must change as the nudge does.
    """

    def __init__(self) -> None:
        self._sent: deque[tuple[int, Pwm]] = deque()
        """The last of each 0.7 s; after a release, those before it."""
        self._since_ns: int | None = None
        """First override of this check; None while the sticks are released."""
        self._baseline: Pwm | None = None
        """Last sticks that were shown before ours."""
        self._matched_ns: int | None = None
        """Arrival of the last echo; None = not confirmed."""
        self._shown_us: int | None = None
        self._arrived_ns: int | None = None
        """Arrival of the last RC_CHANNELS."""
        self._held: Pwm | None = None
        self._held_since_us = 0
        self._held_samples = 0
        self._returned_us: deque[int] = deque(maxlen=RETURNED_SAMPLES)
        self._fault: EchoFault | None = None
        self._fault_ns = 0
        self.is_released = True
        """Other sticks than ours were shown since the release, or none was ever sent."""
        self.shows_last = False
        """The sticks that were shown since the release are, or cannot be told from, our last."""
        self.has_sent = False
        """At least one override was sent in this session."""

    @property
    def confirmed(self) -> bool:
        """The vehicle acts on our sticks."""
        return self._matched_ns is not None

    @property
    def is_sending(self) -> bool:
        """Sticks were sent and not released since."""
        return self._since_ns is not None

    def with_nudge(self, pwm_us: Pwm, now_ns: int) -> Pwm:
        """The values to send: roll walks by up to two steps towards the middle, never outwards.

        So the echo of a vehicle that takes our packets changes all the time, and differs from a
        receiver whose sticks rest where ours do.
        """
        throttle, yaw, pitch, roll = pwm_us
        step_us = NUDGE_US if self.confirmed else SEEK_NUDGE_US
        nudge_us = now_ns // NUDGE_STEP_NS % _NUDGE_LEVELS * step_us
        return throttle, yaw, pitch, roll + (nudge_us if roll <= _MIDDLE_US else -nudge_us)

    def sent(self, pwm_us: Pwm, now_ns: int) -> None:
        """Note an override that was sent."""
        if self._since_ns is None:
            self._since_ns, self.has_sent, self.is_released = now_ns, True, False
            self._sent.clear()
        elif now_ns - self._sent[-1][0] > _PAUSE_NS:
            self._held = None
        self._sent.append((now_ns, pwm_us))
        while self._sent[0][0] < now_ns - MATCH_NS:
            self._sent.popleft()

    def released(self) -> None:
        """Overriding has ended: the next one starts a new check."""
        self.shows_last &= not self.is_sending
        self._since_ns = self._matched_ns = self._held = None
        self._returned_us.clear()

    def received(self, pwm_us: Pwm, shown_us: int, now_ns: int) -> None:
        """Compare the stick channels of one RC_CHANNELS, stamped ``shown_us`` by the vehicle.

        Late and doubled datagrams are left out.
        """
        if self._shown_us is not None and shown_us <= self._shown_us:
            return
        if self._arrived_ns is not None and now_ns - self._arrived_ns > CONFIRM_NS:
            self._restart(now_ns)
        self._shown_us, self._arrived_ns = shown_us, now_ns
        is_ours = any(_is_near(pwm_us, past) for _, past in reversed(self._sent))
        if self._since_ns is None:
            self._baseline = pwm_us
            # Ours are shown to the microsecond: a receiver that rests beside them is told apart.
            self.is_released |= all(pwm_us != past for _, past in self._sent)
            self.shows_last = bool(self._sent) and _is_near(pwm_us, self._sent[-1][1])
        elif not self.confirmed:
            self._seek(pwm_us, is_ours, now_ns)
        elif is_ours:
            self._matched_ns = now_ns
        elif self._baseline is None or not _is_near(pwm_us, self._baseline):
            self._fail("foreign", now_ns)
        else:
            self._returned_us.append(shown_us)
            is_often = len(self._returned_us) == RETURNED_SAMPLES
            if is_often and shown_us - self._returned_us[0] <= RETURNED_US:
                self._fail("returned", now_ns)
        if self.confirmed:
            self._watch_change(pwm_us, shown_us, now_ns)

    def _restart(self, now_ns: int) -> None:
        """Nothing was shown for so long that the vehicle may rightly show what it likes now."""
        if self.is_sending:
            self._since_ns, self._matched_ns, self._held = now_ns, None, None
            self._returned_us.clear()
        if self._fault == "unseen":
            self._fault = None

    def _seek(self, pwm_us: Pwm, is_ours: bool, now_ns: int) -> None:
        if not is_ours:
            self._baseline = pwm_us
        elif self._baseline is None or not _is_near(pwm_us, self._baseline):
            self._matched_ns = now_ns
            if self._fault == "unseen":
                self._fault = None

    def _watch_change(self, pwm_us: Pwm, shown_us: int, now_ns: int) -> None:
        if pwm_us != self._held:
            self._held, self._held_since_us, self._held_samples = pwm_us, shown_us, 0
        self._held_samples += 1
        held_us = shown_us - self._held_since_us
        if held_us >= SILENT_US and self._held_samples >= SILENT_SAMPLES:
            self._fail("silent", now_ns)

    def _fail(self, fault: EchoFault, now_ns: int) -> None:
        """Note a fault; of several in a row the first is the likely cause."""
        if self._fault is None or now_ns - self._fault_ns >= _RETRY_NS:
            self._fault = fault
        self._fault_ns = now_ns

    def fault(self, now_ns: int) -> EchoFault | None:
        """The way in which the vehicle does not act on our sticks; kept for 3 s after it ends."""
        newest_ns = max(self._since_ns or 0, self._matched_ns or 0)
        if self.is_sending and now_ns - newest_ns > CONFIRM_NS:
            self._fail("unseen", now_ns)
        return self._fault if now_ns - self._fault_ns < _RETRY_NS else None
