"""Telemetry requests at the policy's rate, repeated whenever a stream slows down."""

from collections import Counter
from collections.abc import Callable, Iterator

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.messages import CommandAck, CommandRequest
from mavbridge.mavlink.codec.readers import IDS
from mavbridge.mavlink.profiles.profile import StreamGroup

_ACK_TIMEOUT_NS = 500 * NS_PER_MS
_ATTEMPTS = 4
_PAUSE_NS = 10 * NS_PER_S
"""Time between two requests for an optional message that the vehicle has denied or left unanswered,
so that a slow link is not loaded for ever. The first pauses are shorter: a gap of the link looks
alike."""
_LOWEST_HZ = 25.0
_WATCH_NS = 2 * NS_PER_S
_UNDECIDED = (dialect.MAV_RESULT_TEMPORARILY_REJECTED, dialect.MAV_RESULT_IN_PROGRESS)
_ENOUGH = 0.7
"""Fraction of the granted rate below which another station is assumed to have changed it."""
_RARE = 0.125
"""Fraction of the granted rate at or below which a message is as good as absent: HEARTBEAT at 1 Hz
in place of 10."""
_ALIKE = 0.2
"""Relative spread of the streams' rate fractions below which they have one cause."""
_AWAY_NS = 250 * NS_PER_MS
_STAND_IN_NS = 50 * NS_PER_MS
"""Time between two requests for a stand-in, once its stream has been away for ``_AWAY_NS``."""
_SCALED_WINDOWS = 2
"""Consecutive windows at one rate fraction that mean a full link; a single one may be a hiccup."""


class _Stream:
    """Negotiation of message, rate and kind of request for one group."""

    def __init__(self, group: StreamGroup) -> None:
        self.has_settled = False
        """True if it has been granted or put off once."""
        self.was_settled = False
        """True if it had been when the counting window began."""
        self.received: Counter[str] = Counter()
        """Messages by name: a vehicle may also send another one of the group unrequested."""
        self.newest_ns = self.stand_in_due_ns = self.due_ns = 0
        self.misses = 0
        """Times in a row that an optional group was put off."""
        self.is_absence_told = False
        self.want(group)

    def want(self, group: StreamGroup) -> None:
        """Begin, or begin again for this group of the same messages."""
        self.group = group
        self._options = _options(group)
        self._at = self.attempts = 0
        self.is_settled = self.is_denied = False
        """Denied: so was each option; request again after a pause."""

    @property
    def rate_hz(self) -> float:
        """Rate of the present option."""
        return self._options[self._at][1]

    def request(self) -> CommandRequest:
        """Return the next request."""
        self.attempts += 1
        self.is_denied = False
        return self._options[self._at][0]

    def settle(self) -> None:
        """Note that the group is granted, or put off until its rate is looked at."""
        self.is_settled, self.has_settled, self.attempts = True, True, 0

    def refuse(self, now_ns: int) -> None:
        """Go on to the next option; an optional group is put off."""
        if self.group.is_needed:
            self._at, self.attempts = (self._at + 1) % len(self._options), 0
            self.is_denied = self._at == 0
        else:
            self.put_off(now_ns)

    def put_off(self, now_ns: int) -> None:
        """Request an optional group again after a pause, unless it comes meanwhile."""
        self.settle()
        self.due_ns = now_ns + min(_WATCH_NS << self.misses, _PAUSE_NS)
        self.misses += 1

    def arriving_hz(self, span_s: float) -> float:
        """Return the arrival rate of the group's most frequent message."""
        return max(self.received.values(), default=0) / span_s

    def is_slow(self, span_s: float) -> bool:
        least_hz = self.group.least_hz
        least_hz = _ENOUGH * self.rate_hz if least_hz is None else least_hz
        return self.arriving_hz(span_s) <= least_hz


def _options(group: StreamGroup) -> list[tuple[CommandRequest, float]]:
    """Return the requests for a group and their rates; "denied" may mean too fast or unknown."""
    rates_hz = [group.rate_hz]
    while rates_hz[-1] / 2 >= _LOWEST_HZ:
        rates_hz.append(rates_hz[-1] / 2)
    interval = dialect.MAV_CMD_SET_MESSAGE_INTERVAL
    return [
        (CommandRequest(interval, (IDS[name], 1e6 / rate_hz)), rate_hz)
        for name in group.messages
        for rate_hz in rates_hz
    ]


class StreamRequester:
    """Keeps all groups coming, with one open request at a time, since acks carry no message id.

    A vehicle slows down all streams of an overloaded link alike, without notice. ``report`` then
    gets one text for the user, and the flight uses the messages that arrive. Lower requests would
    not help: PX4 gives the freed bandwidth to its unrequested streams (on a link of 4 kB/s, 7.5 Hz
    of 100 became 1.6 Hz when 6.7 were requested).
    """

    def __init__(
        self,
        wanted: tuple[StreamGroup, ...],
        *,
        report: Callable[[str], None] = lambda _: None,
        has_slow_clock: Callable[[], bool] = lambda: False,
    ) -> None:
        self._report = report
        self._has_slow_clock = has_slow_clock
        self._streams: list[_Stream] = []
        self._by_message: dict[str, _Stream] = {}
        self._pending: _Stream | None = None
        self._requested_ns = 0
        self._window_ns: int | None = None
        """Start of the counting window; None while requests are open."""
        self._scaled_windows = 0
        self._has_told = False
        self.renewals = 0
        for group in wanted:
            self.add(group)

    def add(self, group: StreamGroup) -> None:
        """Add a group, unless its message already comes at that rate."""
        known = self._by_message.get(group.messages[0])
        if known is not None and known.group.rate_hz < group.rate_hz:
            known.want(group)
        elif known is None:
            stream = _Stream(group)
            self._streams.append(stream)
            self._by_message |= dict.fromkeys(group.messages, stream)

    @property
    def is_settled(self) -> bool:
        """True if every required group is granted."""
        return all(stream.is_settled or not stream.group.is_needed for stream in self._streams)

    def receive(self, name: str, arrived_ns: int) -> None:
        """Count one message."""
        if (stream := self._by_message.get(name)) is not None:
            stream.received[name] += 1
            stream.newest_ns = arrived_ns

    def has_settled(self, group: StreamGroup) -> bool:
        """True if this group has been granted or put off."""
        return self._by_message[group.messages[0]].has_settled

    def has_come(self, name: str) -> bool:
        """True if this message has come since it was wanted."""
        stream = self._by_message.get(name)
        return stream is not None and stream.newest_ns > 0

    def receive_ack(self, ack: CommandAck) -> None:
        """Process the vehicle's answer to the open request."""
        if self._pending is None or ack.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            return
        if ack.result in _UNDECIDED:
            return  # repeated as if there were no answer
        if ack.result == dialect.MAV_RESULT_ACCEPTED:
            self._pending.misses = 0
            self._pending.settle()
        else:
            self._pending.refuse(self._requested_ns)
        self._pending = None

    def step(self, now_ns: int) -> CommandRequest | None:
        """Return the request that is due, or None."""
        self._check_rates(now_ns)
        if self._pending is not None:
            if now_ns - self._requested_ns < _ACK_TIMEOUT_NS:
                return None
            if self._pending.attempts >= (1 if self._pending.misses else _ATTEMPTS):
                if self._pending.newest_ns > self._requested_ns:  # granted: the answer was lost
                    self._pending.settle()
                elif not self._pending.group.is_needed:  # the others first
                    self._pending.put_off(now_ns)
                    self._streams.remove(self._pending)
                    self._streams.append(self._pending)
        may_repeat = now_ns - self._requested_ns >= _ACK_TIMEOUT_NS
        open_streams = (s for s in self._streams if not s.is_settled and now_ns >= s.due_ns)
        self._pending = next((s for s in open_streams if may_repeat or not s.is_denied), None)
        if self._pending is None:
            return None
        self._requested_ns = now_ns
        return self._pending.request()

    def stand_ins(self, now_ns: int) -> Iterator[CommandRequest]:
        """Yield requests for the stand-ins of missing streams."""
        for stream in self._streams:
            name = stream.group.stand_in
            if name is None or not stream.has_settled or now_ns < stream.stand_in_due_ns:
                continue
            if now_ns - stream.newest_ns >= _AWAY_NS:
                stream.stand_in_due_ns = now_ns + _STAND_IN_NS
                yield CommandRequest(dialect.MAV_CMD_REQUEST_MESSAGE, (float(IDS[name]),))

    def _check_rates(self, now_ns: int) -> None:
        if not self.is_settled:
            self._window_ns = None
            return
        if self._window_ns is not None:
            if now_ns - self._window_ns < _WATCH_NS:
                return
            self._judge((now_ns - self._window_ns) / NS_PER_S)
        self._window_ns = now_ns
        for stream in self._streams:
            stream.was_settled = stream.has_settled
            stream.received.clear()

    def _judge(self, span_s: float) -> None:
        """Request slow streams again after a window, and report those that did not come at all."""
        share = self._common_share(span_s)
        self._scaled_windows = self._scaled_windows + 1 if share is not None else 0
        if share is not None and self._scaled_windows >= _SCALED_WINDOWS:
            self._tell(share)
            return
        # After a silence, or a reboot that ended all streams, the vehicle lacks nothing.
        needed = [stream for stream in self._streams if stream.group.is_needed]
        is_heard = share is None and not all(stream.is_slow(span_s) for stream in needed)
        for stream in self._streams:
            group, rate_hz = stream.group, stream.arriving_hz(span_s)
            is_rare = stream.is_settled and rate_hz <= _RARE * stream.rate_hz
            is_lacking = not stream.received or (is_rare and group.least_hz is None)
            may_tell = is_heard and stream.was_settled and not stream.is_absence_told
            if group.without and is_lacking and may_tell:
                stream.is_absence_told = True
                comes = f"comes at {rate_hz:.1g} Hz" if stream.received else "does not come"
                self._report(f"{group.messages[0]} {comes}: {group.without}")
            if stream.is_slow(span_s):
                stream.is_settled = False
                self.renewals += stream.group.is_needed

    def _common_share(self, span_s: float) -> float | None:
        """Return the common rate fraction of all required streams, if a full link explains it."""
        needed = [stream for stream in self._streams if stream.group.is_needed and stream.received]
        shares = [stream.arriving_hz(span_s) / stream.rate_hz for stream in needed]
        if len(shares) < 2:
            return None
        mean = sum(shares) / len(shares)
        is_alike = max(shares) - min(shares) <= _ALIKE * mean
        return mean if is_alike and mean < _ENOUGH else None

    def _tell(self, share: float) -> None:
        if self._has_told or self._has_slow_clock():
            return
        self._has_told = True
        wanted_hz = self._streams[0].rate_hz
        self._report(
            f"the link carries only {share:.0%} of the telemetry that was asked for: states come "
            f"at {share * wanted_hz:.3g} Hz instead of {wanted_hz:.3g} Hz; use a faster link (a "
            "higher baud rate; on PX4 also MAV_n_RATE, or a MAV_n_MODE with fewer streams of its "
            "own), a better radio if packets are lost, or a lower rates.action"
        )
