"""Echo check: compares sent commands with those that the vehicle shows."""

from collections import deque
from dataclasses import dataclass
from typing import Literal, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.messages import StampOrder

Shown: TypeAlias = tuple[int, ...]
"""Numbers of a message in its own units, for example the PWM of the four sticks in RC_CHANNELS."""
EchoFault: TypeAlias = Literal["unseen", "foreign", "returned", "silent"]
"""unseen: no echo since the first command, or no message that shows one. foreign: values that
neither we nor a source at rest sent. returned: the values shown before our first command. silent:
the vehicle hears us no more: our values, but constant although we keep changing them, or no echo;
the values from before us may follow."""

CONFIRM_NS = NS_PER_S
"""Longest wait for the first echo, and longest gap between echo messages. An override is echoed
after about 14 ms; 200 ms of delay each way and a few lost packets still leave half of this."""
MATCH_NS = 700 * NS_PER_MS
"""Maximum age of a command that may still be echoed: 200 ms of delay each way, a value held through
five lost packets at 30 Hz, one interval of the echo message, and a margin."""
MOST_COMMANDS = 2048
"""Five seconds at 400 Hz: longer than a vehicle holds sticks that it no longer hears."""
OFTEN_US = 500_000
RETURNED_SAMPLES = 2
"""Samples within OFTEN_US that show the values from before us and count as a fault. One is a stray
release of another station; a joystick at 50 Hz causes a quarter to a half of 29 RC_CHANNELS.
Values that only another overrider can have sent are a fault at the first sample: at 10 Hz they are
shown only once or twice."""
DITHER_STEP_NS = 25 * NS_PER_MS
_DITHER_LEVELS = 3
"""Number of dither levels, 25 ms each, by time and not by packet: no usual rate of commands or
echoes hits the same level each time, and one lost packet never makes two levels look like one."""
_PAUSE_NS = 100 * NS_PER_MS
"""Pause in our commands after which nothing is judged: a constant echo is normal then, and an old
fault must not prevent every new attempt."""
_RETRY_NS = 3 * NS_PER_S
"""Time for which a fault is reported after it was last seen."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EchoRules:
    """Rules of the echo check for one message."""

    tolerance: int
    """Largest difference from the sent value, and largest movement of another source at rest."""
    release_tolerance: int = 0
    """Tolerance after the release, to tell our last values from a source at rest beside them."""
    dithered: int
    """Index of the number that is dithered, so that its echo changes."""
    dither: int
    """Dither step after the echo is confirmed."""
    seek_dither: int
    """Dither step before: above ``tolerance``, so that no idle source is mistaken for our echo."""
    centre: int
    """Value towards which the dither goes."""
    foreign_samples: int = 1
    """Unrecognised samples per 0.5 s that count as a fault. More than one if a mode change shows
    foreign values for a moment before the new mode is reported."""
    longest_pause_ns: int = NS_PER_S
    """Gap in the echo messages after which our commands count as lost."""
    silent_us: int = 400_000
    """Longest time that the echo may be constant, by the vehicle's clock. The command changes every
    25 ms, so that 20 % of loss in both directions leaves a dozen changes in this time."""
    silent_samples: int = 8
    """Fewest repetitions in ``silent_us``, as at 20 Hz: after losses a few may agree by chance."""
    hand: int = 0
    """Largest movement of another source at rest since our first command: more shows a hand. 0: the
    message does not show sticks."""


class EchoCheck:
    """Checks that the vehicle acts on our commands, on no others, and on fresh ones.

    The echo is confirmed when the vehicle shows sent values that it did not show before. From then
    on each message must match a recent command and must change as the dither does.
    """

    def __init__(self, rules: EchoRules) -> None:
        self._rules = rules
        self._sent: deque[tuple[int, Shown]] = deque(maxlen=MOST_COMMANDS)
        """Commands since 0.7 s before the last echo message; after a release, until that."""
        self._since_ns: int | None = None
        """First command of this check; None while released."""
        self._tried_ns = 0
        """Last command, including failed sends."""
        self._baseline: Shown | None = None
        """Last values shown before ours."""
        self._matched_ns: int | None = None
        """Arrival of the last echo; None: not confirmed."""
        self._held_ours: Shown | None = None
        """Shown value that is ours, as long as it is shown: a deaf vehicle holds it for seconds."""
        self._order = StampOrder()
        self._arrived_ns: int | None = None
        """Arrival of the last echo message."""
        self._held: Shown | None = None
        self._held_since_us = 0
        self._held_samples = 0
        self._returned_us: deque[int] = deque(maxlen=RETURNED_SAMPLES)
        self._foreign_us: deque[int] = deque(maxlen=rules.foreign_samples)
        self._fault: EchoFault | None = None
        self._fault_ns = 0
        self.is_released = True
        """True if values other than ours were shown since the release, or none was ever sent."""
        self.shows_last = False
        """True if the vehicle shows our last command since the release, or values like it."""
        self.has_sent = False
        """True if a command was sent in this session."""

    @property
    def confirmed(self) -> bool:
        """True if the vehicle acts on our commands."""
        return self._matched_ns is not None

    @property
    def is_sending(self) -> bool:
        """True if a command was sent and not released since."""
        return self._since_ns is not None

    def is_unshown(self, now_ns: int, pause_ns: int | None = None) -> bool:
        """True if no echo message has arrived for too long."""
        pause_ns = pause_ns or self._rules.longest_pause_ns
        return self._arrived_ns is None or now_ns - self._arrived_ns > pause_ns

    def is_deaf(self, now_ns: int) -> bool:
        """True if the vehicle shows sticks of ours since the release, and not the last ones."""
        return not (self._held_ours is None or self.shows_last or self.is_unshown(now_ns))

    def with_dither(self, wanted: Shown, now_ns: int) -> Shown:
        """Return the values to send, one dithered by up to two steps, so that its echo changes."""
        rules, at = self._rules, self._rules.dithered
        step = rules.dither if self.confirmed else rules.seek_dither
        dither = now_ns // DITHER_STEP_NS % _DITHER_LEVELS * step
        value = wanted[at] + (dither if wanted[at] <= rules.centre else -dither)
        return (*wanted[:at], value, *wanted[at + 1 :])

    def showed(self, values: Shown) -> None:
        """Note the values of a message from before this check, unless one has come since."""
        if self._baseline is None and not self.is_sending:
            self._baseline = values

    def tried(self, now_ns: int) -> None:
        """Note a command, sent or not: its echo is expected from now on."""
        self._tried_ns = now_ns
        if self._since_ns is None:
            self._since_ns, self._held_ours = now_ns, None
            self._sent.clear()

    def sent(self, values: Shown, now_ns: int) -> None:
        """Note a sent command by the values that its echo will show."""
        self.tried(now_ns)
        self.has_sent, self.is_released = True, False
        if self._sent and self._is_paused(now_ns):
            self._held = None
            if now_ns - self._sent[-1][0] > MATCH_NS:
                self._restart(now_ns)
        self._sent.append((now_ns, values))

    def released(self) -> None:
        """Note the end of sending; the next command starts a new check."""
        self.shows_last &= not self.is_sending
        self._since_ns = self._matched_ns = None
        self._forget_shown()

    def received(self, values: Shown, shown_us: int, now_ns: int) -> None:
        """Compare the values of a message stamped ``shown_us`` by the vehicle; skip late ones."""
        newest_us = self._order.newest_us
        if not self._order.accepts(shown_us):
            return
        if shown_us < newest_us:  # do not compare old stamps with new ones
            self._forget_shown()
        if self.is_unshown(now_ns) and self._arrived_ns is not None:
            # Slow echoes must not put off the end of the wait for the first one of ours.
            if self.confirmed:
                self._forget_shown()
            elif not self.is_sending or now_ns - self._arrived_ns > CONFIRM_NS:
                self._restart(now_ns)
        self._arrived_ns = now_ns
        if self._since_ns is None:
            self._baseline = values
            apart = self._rules.release_tolerance
            is_ours = any(_is_within(apart, values, past) for _, past in self._sent)
            self._held_ours = values if is_ours or values == self._held_ours else None
            self.is_released |= self._held_ours is None
            self.shows_last = bool(self._sent) and self._is_near(values, self._sent[-1][1])
        elif self._is_paused(now_ns):
            self._forget_shown()
            if not self._sent or now_ns - self._sent[-1][0] > MATCH_NS:
                self._baseline = values
        else:
            self._judge(values, shown_us, now_ns)

    def _judge(self, values: Shown, shown_us: int, now_ns: int) -> None:
        """Compare the shown values while we send."""
        is_held = values == self._held_ours
        while self._sent[0][0] < now_ns - MATCH_NS:
            is_held |= self._is_near(values, self._sent.popleft()[1])
        is_ours = any(self._is_near(values, past) for _, past in reversed(self._sent))
        is_held &= not is_ours
        self._held_ours = values if is_ours or is_held else None
        before, rules = self._baseline, self._rules
        if is_held:
            pass
        elif is_ours and (self.confirmed or before is None or not self._is_near(values, before)):
            self._matched_ns = now_ns
            self._fault = None if self._fault == "unseen" else self._fault
        elif not self.confirmed:
            self._baseline = before if is_ours else values
        elif before is None or not _is_within(max(rules.hand, rules.tolerance), values, before):
            if rules.hand > 0 and before is None:
                self._baseline = values  # perhaps a source that rests as it did before ours
            if _is_often(self._foreign_us, shown_us):
                self._fail("foreign", now_ns, is_hand=rules.hand > 0 and before is not None)
        elif (was_held := self._is_held(shown_us)) or _is_often(self._returned_us, shown_us):
            self._fail("silent" if was_held else "returned", now_ns)
        if self.confirmed or is_held:
            self._watch_change(values, shown_us, now_ns)

    def _forget_shown(self) -> None:
        """Start counting anew what the vehicle shows."""
        self._held = None
        self._returned_us.clear()
        self._foreign_us.clear()

    def _is_near(self, one: Shown, other: Shown) -> bool:
        return _is_within(self._rules.tolerance, one, other)

    def _is_paused(self, now_ns: int) -> bool:
        """True if our last command is too old for the echo to tell anything about us."""
        return not self._sent or now_ns - self._sent[-1][0] > _PAUSE_NS

    def _restart(self, now_ns: int) -> None:
        """Restart echo tracking after a gap in commands, when any value is legitimate."""
        if self.is_sending:
            self._since_ns, self._matched_ns = now_ns, None
            self._forget_shown()
        if self._fault == "unseen":
            self._fault = None

    def _watch_change(self, values: Shown, shown_us: int, now_ns: int) -> None:
        if values != self._held:
            self._held, self._held_since_us, self._held_samples = values, shown_us, 0
        self._held_samples += 1
        if self._is_held(shown_us):
            self._fail("silent", now_ns)

    def _is_held(self, shown_us: int) -> bool:
        """True if the last shown values had been constant for too long by then."""
        is_shown = self._held is not None and self._held_samples >= self._rules.silent_samples
        return is_shown and shown_us - self._held_since_us >= self._rules.silent_us

    def _fail(self, fault: EchoFault, now_ns: int, *, is_hand: bool = False) -> None:
        """Note a fault; of several in a row a hand counts, else the first, the likely cause."""
        if is_hand or self._fault is None or now_ns - self._fault_ns >= _RETRY_NS:
            self._fault = fault
        self._fault_ns = now_ns

    def fault(self, now_ns: int) -> EchoFault | None:
        """Return the fault of the echo, up to 3 s after its end, or None."""
        if self._since_ns is not None and now_ns - self._tried_ns <= _PAUSE_NS:
            since_ns, longest_ns = self._since_ns, CONFIRM_NS
            if self._matched_ns is not None:
                since_ns, longest_ns = self._matched_ns, self._rules.longest_pause_ns
            if now_ns - since_ns > longest_ns:
                self._fail("unseen", now_ns)
        fault = "silent" if self._fault == "unseen" and self.confirmed else self._fault
        return fault if now_ns - self._fault_ns < _RETRY_NS else None


def _is_often(times_us: deque[int], shown_us: int) -> bool:
    """Note an unexpected value; return True once there are too many."""
    times_us.append(shown_us)
    return len(times_us) == times_us.maxlen and shown_us - times_us[0] <= OFTEN_US


def _is_within(tolerance: int, one: Shown, other: Shown) -> bool:
    pairs = zip(one, other, strict=True)
    return one == other or all(abs(a - b) <= tolerance for a, b in pairs)
