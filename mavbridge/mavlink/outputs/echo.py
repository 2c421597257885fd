"""Echo check: compares what we send with what the vehicle shows of it."""

from collections import deque
from dataclasses import dataclass
from typing import Literal, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.messages import RESTART_STAMPS, RESTART_STEP_US

Shown: TypeAlias = tuple[int, ...]
"""Numbers of a message, in its own units: PWM of the four sticks in RC_CHANNELS, for one."""
EchoFault: TypeAlias = Literal["unseen", "foreign", "returned", "silent"]
"""unseen: no echo since the first command, or no message that shows any. foreign: values that
neither we nor the pilot's receiver sent. returned: those that it showed before us. silent: ours,
but always the same ones, although we keep changing them."""

CONFIRM_NS = NS_PER_S
"""Longest wait for the first echo, and longest pause of the message that shows it: an override is
shown after about 14 ms; 200 ms of delay each way and a few lost packets still leave half of this.
"""
MATCH_NS = 700 * NS_PER_MS
"""Oldest of our commands that may still be shown: 200 ms of delay each way, a value that is held
through five lost packets at 30 Hz, an interval of the message that shows it, and a reserve."""
SILENT_US = 400_000
"""Longest time that the echo may be constant, by the vehicle's clock. We send another value every
25 ms, so that 20 % of loss in both directions leaves a dozen changes in this time."""
SILENT_SAMPLES = 8
"""Fewest messages in that time, as many as come at 20 Hz: where some are lost, a few of them may be
equal by chance."""
OFTEN_US = 500_000
RETURNED_SAMPLES = 2
"""So many messages within this time with the values of before us: one is a stray release of
another station; a joystick at 50 Hz has a quarter to a half of 29 RC_CHANNELS. Sticks that nobody
but another overrider can have sent need no second one: at 10 Hz it is shown but once or twice."""
DITHER_STEP_NS = 25 * NS_PER_MS
_DITHER_LEVELS = 3
"""Three levels of 25 ms, by time and not by packet: no usual rate of commands or of what shows them
hits the same level each time, and one lost packet never makes two levels look like one."""
_PAUSE_NS = 100 * NS_PER_MS
"""After this long without a command of ours nothing is judged: an echo may rightly be constant, and
what lasted until then must not keep us from ever trying again."""
_RETRY_NS = 3 * NS_PER_S
"""A fault stays known for this long after it was last seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EchoRules:
    """Rules by which one message shows what was sent."""

    tolerance: int
    """Largest difference from what was sent, and movement of another source at rest."""
    release_tolerance: int = 0
    """The same where our last values are told from another source that rests beside them."""
    dithered: int
    """Index of the number that we keep changing, so that its echo changes too."""
    dither: int
    """Its step once the echo is confirmed."""
    seek_dither: int
    """Its step until then: more than ``tolerance``, lest a source at rest is taken for us."""
    centre: int
    """The dither goes towards this value, never away from it."""
    foreign_samples: int = 1
    """So many values of nobody's within half a second are a fault. More than one where the vehicle
    shows others for a moment as soon as its mode changes, which is told a little later."""
    longest_pause_ns: int = NS_PER_S
    """After so long without a message that shows them, our commands are taken for lost."""


class EchoCheck:
    """Tells whether the vehicle acts on our commands, on ours alone, and on fresh ones.

    Confirmed when it shows values that we sent and that it did not show before. From then on each
    message must match something that we sent recently, and must change as the dither does.
    """

    def __init__(self, rules: EchoRules) -> None:
        self._rules = rules
        self._sent: deque[tuple[int, Shown]] = deque()
        """The last of each 0.7 s; after a release, those before it."""
        self._since_ns: int | None = None
        """First command of this check; None while the vehicle is released."""
        self._tried_ns = 0
        """Last command, also one that could not be sent."""
        self._baseline: Shown | None = None
        """Last values that were shown before ours."""
        self._matched_ns: int | None = None
        """Arrival of the last echo; None = not confirmed."""
        self._shown_us: int | None = None
        self._arrived_ns: int | None = None
        """Arrival of the last message that shows them."""
        self._old_stamps = 0
        self._held: Shown | None = None
        self._held_since_us = 0
        self._held_samples = 0
        self._returned_us: deque[int] = deque(maxlen=RETURNED_SAMPLES)
        self._foreign_us: deque[int] = deque(maxlen=rules.foreign_samples)
        self._fault: EchoFault | None = None
        self._fault_ns = 0
        self.is_released = True
        """Other values than ours were shown since the release, or none was ever sent."""
        self.shows_last = False
        """The values that were shown since the release are, or cannot be told from, our last."""
        self.has_sent = False
        """At least one command was sent in this session."""

    @property
    def confirmed(self) -> bool:
        """The vehicle acts on our commands."""
        return self._matched_ns is not None

    @property
    def is_sending(self) -> bool:
        """Something was sent and not released since."""
        return self._since_ns is not None

    def is_unshown(self, now_ns: int) -> bool:
        """No message that could show an echo has come for too long."""
        pause_ns = self._rules.longest_pause_ns
        return self._arrived_ns is None or now_ns - self._arrived_ns > pause_ns

    def with_dither(self, wanted: Shown, now_ns: int) -> Shown:
        """The values to send: one walks by up to two steps towards its centre, never outwards.

        So the echo of a vehicle that takes our packets changes all the time, and differs from
        another source that rests where we do.
        """
        rules, at = self._rules, self._rules.dithered
        step = rules.dither if self.confirmed else rules.seek_dither
        dither = now_ns // DITHER_STEP_NS % _DITHER_LEVELS * step
        value = wanted[at] + (dither if wanted[at] <= rules.centre else -dither)
        return (*wanted[:at], value, *wanted[at + 1 :])

    def tried(self, now_ns: int) -> None:
        """Note a command, also one that could not be sent: its echo is awaited from then on."""
        self._tried_ns = now_ns
        if self._since_ns is None:
            self._since_ns = now_ns
            self._sent.clear()

    def sent(self, values: Shown, now_ns: int) -> None:
        """Note a command that was sent, by the values that will be shown of it."""
        self.tried(now_ns)
        self.has_sent, self.is_released = True, False
        if self._sent and self._is_paused(now_ns):
            self._held = None
            if now_ns - self._sent[-1][0] > MATCH_NS:
                self._restart(now_ns)
        self._sent.append((now_ns, values))
        while self._sent[0][0] < now_ns - MATCH_NS:
            self._sent.popleft()

    def released(self) -> None:
        """Sending has ended: the next command starts a new check."""
        self.shows_last &= not self.is_sending
        self._since_ns = self._matched_ns = self._held = None
        self._returned_us.clear()
        self._foreign_us.clear()

    def received(self, values: Shown, shown_us: int, now_ns: int) -> None:
        """Compare the values of one message, stamped ``shown_us`` by the vehicle.

        Late and doubled datagrams are left out; two in a row from long ago are a clock that has
        restarted, or the end of one stamp that was wrong.
        """
        if self._is_late(shown_us):
            return
        if self.is_unshown(now_ns) and self._arrived_ns is not None:
            self._restart(now_ns)
        self._shown_us, self._arrived_ns = shown_us, now_ns
        if self._since_ns is None:
            self._baseline = values
            apart = self._rules.release_tolerance
            self.is_released |= not any(_is_within(apart, values, past) for _, past in self._sent)
            self.shows_last = bool(self._sent) and self._is_near(values, self._sent[-1][1])
        elif self._is_paused(now_ns):
            self._note_pause(values, now_ns)
        else:
            self._judge(values, shown_us, now_ns)

    def _judge(self, values: Shown, shown_us: int, now_ns: int) -> None:
        """Compare what is shown while we send."""
        is_ours = any(self._is_near(values, past) for _, past in reversed(self._sent))
        if not self.confirmed:
            self._seek(values, is_ours, now_ns)
        elif is_ours:
            self._matched_ns = now_ns
        elif self._baseline is None or not self._is_near(values, self._baseline):
            if _is_often(self._foreign_us, shown_us):
                self._fail("foreign", now_ns)
        elif _is_often(self._returned_us, shown_us):
            self._fail("returned", now_ns)
        if self.confirmed:
            self._watch_change(values, shown_us, now_ns)

    def _is_late(self, shown_us: int) -> bool:
        """Older than the last one, and not of a clock that has restarted."""
        if self._shown_us is None or shown_us > self._shown_us:
            self._old_stamps = 0
            return False
        is_far_back = shown_us + RESTART_STEP_US < self._shown_us
        self._old_stamps = self._old_stamps + 1 if is_far_back else 0
        if self._old_stamps < RESTART_STAMPS:
            return True
        self._old_stamps, self._held = 0, None  # no stamp from before it is compared with new ones
        self._returned_us.clear()
        self._foreign_us.clear()
        return False

    def _is_near(self, one: Shown, other: Shown) -> bool:
        return _is_within(self._rules.tolerance, one, other)

    def _is_paused(self, now_ns: int) -> bool:
        """Nothing of ours has left for so long that what is shown tells nothing about us."""
        return not self._sent or now_ns - self._sent[-1][0] > _PAUSE_NS

    def _note_pause(self, values: Shown, now_ns: int) -> None:
        """Judge nothing; after a long pause these are the values of before the next command."""
        self._held = None
        self._returned_us.clear()
        self._foreign_us.clear()
        if not self._sent or now_ns - self._sent[-1][0] > MATCH_NS:
            self._baseline = values

    def _restart(self, now_ns: int) -> None:
        """Nothing was shown, or sent, for so long that the vehicle may rightly show anything."""
        if self.is_sending:
            self._since_ns, self._matched_ns, self._held = now_ns, None, None
            self._returned_us.clear()
            self._foreign_us.clear()
        if self._fault == "unseen":
            self._fault = None

    def _seek(self, values: Shown, is_ours: bool, now_ns: int) -> None:
        if not is_ours:
            self._baseline = values
        elif self._baseline is None or not self._is_near(values, self._baseline):
            self._matched_ns = now_ns
            if self._fault == "unseen":
                self._fault = None

    def _watch_change(self, values: Shown, shown_us: int, now_ns: int) -> None:
        if values != self._held:
            self._held, self._held_since_us, self._held_samples = values, shown_us, 0
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
        """The way in which it does not act on our commands; kept for 3 s after it ends."""
        if self._since_ns is not None and now_ns - self._tried_ns <= _PAUSE_NS:
            since_ns, longest_ns = self._since_ns, CONFIRM_NS
            if self._matched_ns is not None:
                since_ns, longest_ns = self._matched_ns, self._rules.longest_pause_ns
            if now_ns - since_ns > longest_ns:
                self._fail("unseen", now_ns)
        return self._fault if now_ns - self._fault_ns < _RETRY_NS else None


def _is_often(times_us: deque[int], shown_us: int) -> bool:
    """Note a value that should not be shown; True once there are too many."""
    times_us.append(shown_us)
    return len(times_us) == times_us.maxlen and shown_us - times_us[0] <= OFTEN_US


def _is_within(tolerance: int, one: Shown, other: Shown) -> bool:
    pairs = zip(one, other, strict=True)
    return one == other or all(abs(a - b) <= tolerance for a, b in pairs)
