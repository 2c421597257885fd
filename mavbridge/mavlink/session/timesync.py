"""Offset between the vehicle's clock and ours, by TIMESYNC."""

from collections import deque

from mavbridge.core.clock import NS_PER_S, period_ns
from mavbridge.core.histogram import Histogram
from mavbridge.mavlink.codec.messages import Timesync

TIMESYNC_HZ = 2.0
"""TIMESYNC requests; the minimum-delay filter wants a few a second."""
_WINDOW = 20
_OUTSTANDING = 8


class TimesyncFilter:
    """Keeps the offset of the fastest recent exchange, which was queued for the shortest time.

    Only answers to our own outstanding requests count: replies are broadcast, and those to another
    station would look like absurd round trips.
    """

    def __init__(self) -> None:
        self._outstanding: deque[int] = deque(maxlen=_OUTSTANDING)
        self._samples: deque[tuple[int, int]] = deque(maxlen=_WINDOW)
        self._next_ns = 0
        self.round_trips = Histogram()

    def request(self, now_ns: int) -> int | None:
        """The ts1 of the request that is due, if any."""
        if now_ns < self._next_ns:
            return None
        self._next_ns = now_ns + period_ns(TIMESYNC_HZ)
        self._outstanding.append(now_ns)
        return now_ns

    def receive(self, reply: Timesync, arrived_ns: int) -> None:
        """Take a TIMESYNC; requests and replies to other stations are ignored."""
        if reply.tc1 == 0 or reply.ts1 not in self._outstanding:
            return
        self._outstanding.remove(reply.ts1)
        round_trip_ns = arrived_ns - reply.ts1
        if 0 <= round_trip_ns < NS_PER_S:
            self._samples.append((round_trip_ns, reply.tc1 - (reply.ts1 + arrived_ns) // 2))
            self.round_trips.add(round_trip_ns)

    @property
    def offset_ns(self) -> int | None:
        """Vehicle clock minus ours; None before the first exchange."""
        return min(self._samples)[1] if self._samples else None
