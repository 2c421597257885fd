"""Counters of the link over one flight."""

from collections import Counter
from collections.abc import Mapping

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.vehicle import LinkStats
from mavbridge.mavlink.session.timesync import TimesyncFilter

_MOST_OVERTAKEN = 16
"""Largest number of messages that overtake one; a longer step back is an outage."""


class LinkCounters:
    """Counters of messages and losses of the chosen vehicle."""

    def __init__(self) -> None:
        self._by_name: Counter[str] = Counter()
        self._last_sequence: int | None = None
        self._lost = 0
        self._first_ns: int | None = None
        self.heard_ns = 0
        """Arrival of the newest message; 0 before the first."""
        self.sent = 0

    def receive(self, name: str, sequence: int, arrived_ns: int) -> None:
        """Count one message, and a gap in its 8-bit sequence number as losses (modulo 256).

        An overtaken message fills the gap that it left; a doubled one leaves none.
        """
        self._by_name[name] += 1
        last = self._last_sequence
        ahead = 1 if last is None else (sequence - last) % 256
        if ahead >= 256 - _MOST_OVERTAKEN:
            self._lost = max(self._lost - 1, 0)
        elif ahead > 0:
            self._lost += ahead - 1
            self._last_sequence = sequence
        self._first_ns = arrived_ns if self._first_ns is None else self._first_ns
        self.heard_ns = arrived_ns

    def new_sequence(self) -> None:
        """Accept any sequence number next: the sender has restarted."""
        self._last_sequence = None

    def stats(
        self,
        timesync: TimesyncFilter,
        *,
        echo_confirmed: bool | None,
        unusable_packets: int,
        refused_signatures: int,
        saturated: Mapping[str, int],
    ) -> LinkStats:
        """Return the totals; ``saturated``: messages in which each stick demanded too much."""
        received = self._by_name.total()
        span_ns = self.heard_ns - (self._first_ns or 0)
        error_ns = timesync.error_ns(self.heard_ns)
        return LinkStats(
            messages_per_s=tuple(
                (name, count * NS_PER_S / span_ns)
                for name, count in sorted(self._by_name.items())
                if span_ns > 0
            ),
            lost_fraction=self._lost / (self._lost + received) if received else None,
            rtt_ms=timesync.round_trips.percentiles_ms(),
            sent_overrides=self.sent,
            echo_confirmed=echo_confirmed if self.sent else None,
            unusable_packets=unusable_packets,
            refused_signatures=refused_signatures,
            saturated=tuple(
                (name, n / self.sent) for name, n in sorted(saturated.items()) if self.sent
            ),
            vehicle_clock_offset_ns=timesync.offset_ns,
            is_timesync_good=timesync.is_good,
            slow_clock=None if (slow := timesync.slow_clock) is None else str(slow),
            timesync_error_ms=None if error_ns is None else error_ns / NS_PER_MS,
        )
