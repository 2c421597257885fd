"""Offset between the vehicle's clock and ours by TIMESYNC, and measurement times from it."""

from collections import deque
from collections.abc import Callable
from typing import NamedTuple

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, period_ns
from mavbridge.core.histogram import Histogram
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import AdviceText
from mavbridge.mavlink.codec.messages import WRAP_US, Timesync

TIMESYNC_HZ = 5.0
"""Request rate: the offset is good one second after the first, a step is seen within 0.2 s."""
GOOD_EXCHANGES = 5
"""Number of agreeing exchanges after which the vehicle's stamps are trusted."""
LONGEST_ROUND_TRIP_NS = 2 * NS_PER_S
"""Longest useful round trip: slower ones say too little about the offset, and a link this slow
loses its heartbeats."""
UNIX_US = 10**15
"""Stamps from here on are Unix time (MAVLink's rule for ``time_usec``), too late for an uptime."""
MAX_AHEAD_NS = 20 * NS_PER_MS
"""Largest lead of a stamp over our time, beyond the offset's error: simulator clocks are uneven."""
SAME_CLOCK_NS = 100 * NS_PER_MS
"""Largest difference between stamps of one clock; two vehicles do not boot that close by chance."""
LONGEST_SENDING_NS = 150 * NS_PER_MS
"""Longest way to the vehicle; later sticks would act on measurements that are too old."""
_LATE_IN_A_ROW = 2
"""Consecutive late requests that count as late: a single one may have waited for a busy vehicle.
One that took twice the limit counts alone, since a lossy link lets few through."""
_STAMPS = 3
"""Number of stamps that judge an exchange: few, since the clock of a slow simulator falls back."""
_OUTSTANDING = 16
_PACE_NS = 4 * NS_PER_S
"""Time over which the pace of the vehicle's clock is measured, in two halves that must agree: a
clock step or a paused simulator is no slow clock."""
SLOW_PACE = 0.9
"""Pace, relative to our clock, below which the vehicle is a slow simulator."""
_DRIFT_PER = 10_000
"""Clocks may drift apart by 1 in 10,000; crystals of autopilots and computers drift by half."""
_UNSTEADY_PER = 200
"""A clock that is off by more than 1 in 200 has stepped, or runs unevenly."""
_TRUST_NS = 5 * NS_PER_S
"""Longest wait for agreeing exchanges before the user is told; a slow clock is known by then."""
_UNEVEN_NS = 10 * NS_PER_MS
"""Harmless unevenness: the clock of ArduPilot's SITL advances in steps of 6 ms, and was seen to
waver by as much against the wall clock."""


class _Exchange(NamedTuple):
    at_ns: int
    offset_ns: int
    """Vehicle's clock minus ours, if both directions took equally long."""
    error_ns: int
    """Half the round trip, the maximum error of the offset."""


class TimesyncFilter:
    """Estimates the offset from the most accurate exchange with one session of a vehicle.

    A request and its answer that together take t give the offset within t / 2, however t is split
    between the directions. So the fastest exchange is kept, however old, until possible clock drift
    makes a newer one as accurate: a delay that begins in flight does not move the offset, and shows
    as age. An exchange that contradicts the kept one shows that the vehicle's clock has stepped or
    drifts, and replaces it, unless the vehicle's own stamps contradict the new one: ArduPilot dates
    its answers back by the bytes that wait at the port, at the port's baud rate, also over TCP
    (29 ms were measured at 57600 baud while setpoints were sent).

    Only answers to our own outstanding requests count: replies are broadcast, and those to another
    station would look like absurd round trips.
    """

    def __init__(self, report: Callable[[str], None] = lambda _: None) -> None:
        """``report`` tells the user once why the vehicle's stamps are not trusted."""
        self._report = report
        self._outstanding: deque[int] = deque(maxlen=_OUTSTANDING)
        self._best: _Exchange | None = None
        self._agreeing = 0
        self._least_ns: deque[int] = deque(maxlen=_STAMPS)
        """Lower bounds of the offset by the newest stamps, none of which is later than its
        arrival."""
        self._sending_ns: deque[int] = deque(maxlen=_LATE_IN_A_ROW)
        self._next_ns = 0
        self._clocks: deque[tuple[int, int]] = deque()
        """Arrival and vehicle time of the newest answers."""
        self.round_trips = Histogram()
        self._trusted_ns: int | None = None
        """Last answer with a good offset, or else the first request; None before it."""
        self._has_told = False

    def request(self, now_ns: int, early_ns: int = 0) -> int | None:
        """Return the ts1 of the request that is due now or within ``early_ns``, else None."""
        if now_ns + early_ns < self._next_ns:
            return None
        self._next_ns = now_ns + period_ns(TIMESYNC_HZ)
        self._outstanding.append(now_ns)
        if self._trusted_ns is None:
            self._trusted_ns = now_ns
        elif not self._has_told and now_ns - self._trusted_ns > _TRUST_NS:
            self._has_told = True
            fault = "is not answered in time (a router drops it, or the link is slow)"
            if self._clocks:
                fault = "answers are too few, or disagree"
            self._report(AdviceText(f"TIMESYNC {fault}: a delay of the link may not be seen"))
        return now_ns

    def receive(self, reply: Timesync, arrived_ns: int) -> None:
        """Process a TIMESYNC; ignore requests, and replies to other stations."""
        if reply.tc1 == 0 or reply.ts1 not in self._outstanding:
            return
        self._outstanding.remove(reply.ts1)
        round_trip_ns = arrived_ns - reply.ts1
        if not 0 <= round_trip_ns < LONGEST_ROUND_TRIP_NS:
            return
        self.round_trips.add(round_trip_ns)
        self._clocks.append((arrived_ns, reply.tc1))
        while arrived_ns - self._clocks[0][0] > _PACE_NS:
            self._clocks.popleft()
        offset_ns = reply.tc1 - (reply.ts1 + arrived_ns) // 2
        new = _Exchange(arrived_ns, offset_ns, round_trip_ns // 2)
        least_ns = max(self._least_ns, default=offset_ns)
        self._least_ns.clear()
        if offset_ns + new.error_ns < least_ns - _UNEVEN_NS:
            return
        best = self._best or new
        known_ns = self._error_ns(best, arrived_ns)
        apart_ns = abs(offset_ns - best.offset_ns) - known_ns - new.error_ns
        if (apart_ns - _UNEVEN_NS) * _UNSTEADY_PER > arrived_ns - best.at_ns:
            self._agreeing = 0
        if apart_ns > 0 or new.error_ns <= known_ns:
            best = new
        self._best = best
        self._agreeing += 1
        self._trusted_ns = arrived_ns if self.is_good else self._trusted_ns
        sending_ns = reply.tc1 - best.offset_ns - reply.ts1
        self._sending_ns.append(sending_ns - self._error_ns(best, arrived_ns))
        if not self._has_told and (slow := self.slow_clock) is not None:
            self._has_told = True
            self._report(str(slow))

    @property
    def slow_clock(self) -> Reason | None:
        """Why the vehicle's stamps lag real time, by its pace relative to our clock, or None."""
        if not self._clocks or self._clocks[-1][0] - self._clocks[0][0] < _PACE_NS * 3 // 4:
            return None
        first, middle, last = (self._clocks[at] for at in (0, len(self._clocks) // 2, -1))
        halves = [
            (end[1] - begin[1]) / (end[0] - begin[0]) if end[0] > begin[0] else 1.0
            for begin, end in ((first, middle), (middle, last))
        ]
        if not all(0 < half < SLOW_PACE for half in halves):
            return None
        return because(Code.SLOW_CLOCK, pace=(last[1] - first[1]) / (last[0] - first[0]))

    @property
    def late_sending(self) -> Reason | None:
        """Why our packets reach the vehicle too late, or None.

        The time on the way is known to within the error of the offset. A link that was equally slow
        from the beginning, in both directions, is therefore not detected.
        """
        if not self.is_good or not self._sending_ns:
            return None
        newest_ns, least_ns = self._sending_ns[-1], min(self._sending_ns)
        is_late = len(self._sending_ns) == _LATE_IN_A_ROW and least_ns > LONGEST_SENDING_NS
        if not is_late and newest_ns <= 2 * LONGEST_SENDING_NS:
            return None
        return because(Code.LATE_SENDING, age_ms=newest_ns / NS_PER_MS)

    def _error_ns(self, exchange: _Exchange, now_ns: int) -> int:
        return exchange.error_ns + (now_ns - exchange.at_ns) // _DRIFT_PER

    @property
    def offset_ns(self) -> int | None:
        """Vehicle's clock minus ours; None before the first exchange."""
        return None if self._best is None else self._best.offset_ns

    def error_ns(self, now_ns: int) -> int | None:
        """Return the maximum error of the offset; None before the first exchange."""
        return None if self._best is None else self._error_ns(self._best, now_ns)

    @property
    def is_good(self) -> bool:
        """True if enough exchanges agree to trust the vehicle's stamps."""
        return self._agreeing >= GOOD_EXCHANGES

    def happened_ns(self, boot_us: int, arrived_ns: int) -> int:
        """Return our time of an event that the vehicle stamped ``boot_us`` after boot.

        Return the arrival if the stamp says nothing. A time more than ``MAX_AHEAD_NS`` after the
        arrival means that the age is unknown.
        """
        delay_ns = self._delay_ns(boot_us, arrived_ns)
        if self._best is None or delay_ns is None:
            return arrived_ns
        self._least_ns.append(self._best.offset_ns - delay_ns)
        is_ahead = -delay_ns > MAX_AHEAD_NS + self._error_ns(self._best, arrived_ns)
        return arrived_ns - delay_ns if delay_ns > 0 or is_ahead else arrived_ns

    def is_same_clock(self, boot_us: int, arrived_ns: int) -> bool:
        """True if a stamp fits the clock that answered TIMESYNC, to within ``SAME_CLOCK_NS``."""
        delay_ns = self._delay_ns(boot_us, arrived_ns)
        return delay_ns is not None and abs(delay_ns) <= SAME_CLOCK_NS

    def _delay_ns(self, boot_us: int, arrived_ns: int) -> int | None:
        """Return the time from a stamp to its arrival, or None if the stamp tells nothing.

        The stamp may be missing (0) or Unix time, or the offset not good yet.
        """
        if self._best is None or not self.is_good or not 0 < boot_us < UNIX_US:
            return None
        wrap_ns = 1000 * WRAP_US
        delay_ns = arrived_ns + self._best.offset_ns - 1000 * boot_us
        return (delay_ns + wrap_ns // 2) % wrap_ns - wrap_ns // 2
