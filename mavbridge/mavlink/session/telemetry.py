"""Newest reading of each quantity, and counters of the messages that carry them."""

from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Iterator

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.vehicle import ForwardedPacket, Reading, Sample, Telemetry
from mavbridge.mavlink.codec.messages import (
    Altitude,
    Attitude,
    LocalVelocity,
    Measurement,
    ReceivedMessage,
    StampOrder,
)
from mavbridge.mavlink.codec.packets import Codec

_YIELD_NS = 300 * NS_PER_MS
"""Silence after which a worse message replaces a better one."""

_FORCE_RANK = {"HIGHRES_IMU": 0, "RAW_IMU": 1, "SCALED_IMU": 1, "SCALED_IMU2": 2}
"""Preference: floats in m/s^2, then the first IMU in milli-g, then the second."""


class _Filter:
    """Selects the messages of one quantity.

    A worse message never replaces a better one that still comes. By the vehicle's stamps, a late or
    duplicate datagram never replaces a newer one.
    """

    def __init__(self) -> None:
        self._rank = 0
        self._arrived_ns: int | None = None
        self._happened_ns = 0
        self._order = StampOrder()

    def delay_ns(self, rank: int, boot_us: int, arrived_ns: int, happened_ns: int) -> int | None:
        """Return the delay of a message that is used, or None; a lower rank is better.

        A negative delay means a timestamp in the future.
        """
        is_live = self._arrived_ns is not None and arrived_ns - self._arrived_ns <= _YIELD_NS
        if (is_live and rank > self._rank) or not self._order.accepts(boot_us):
            return None
        # The offset of the clocks may have improved; a newer message still happened later.
        happened_ns = max(happened_ns, self._happened_ns)
        self._rank, self._arrived_ns = rank, arrived_ns
        self._happened_ns = min(happened_ns, arrived_ns)
        return arrived_ns - happened_ns


class TelemetryCollector:
    """Combines messages into one ``Telemetry``."""

    def __init__(self) -> None:
        self._filters: dict[type[Measurement], _Filter] = defaultdict(_Filter)
        self.telemetry = Telemetry()
        """Newest reading of each quantity."""

    def receive(self, body: Measurement, arrived_ns: int, happened_ns: int) -> tuple[Sample, ...]:
        """Process a message with its arrival and measurement time; return its new samples."""
        rank, values = 0, {}
        if isinstance(body, Attitude):
            rank = 0 if body.is_quaternion else 1
            values = {
                "ned_from_body_wxyz": body.ned_from_body_wxyz,
                "rate_body_radps": body.rate_body_radps,
            }
        elif isinstance(body, LocalVelocity):
            values = {"velocity_ned_mps": body.velocity_ned_mps}
            if body.position_ned_m is not None:
                values["position_ned_m"] = body.position_ned_m
        elif isinstance(body, Altitude):
            values = {"height_above_home_m": (body.above_home_m,)}
        else:
            rank = _FORCE_RANK[body.message_name]
            values = {"specific_force_body_mps2": body.specific_force_body_mps2}
        newest = self._filters[type(body)]
        delay_ns = newest.delay_ns(rank, body.boot_us, arrived_ns, happened_ns)
        if delay_ns is None:
            return ()
        new = {name: Reading(arrived_ns, each, delay_ns) for name, each in values.items()}
        self.telemetry = self.telemetry._replace(**new)
        return tuple(map(Sample._make, new.items()))


_MOST_OVERTAKEN = 16
"""Largest number of messages that overtake one; a longer step back is an outage."""


class LinkCounters:
    """Counters of messages and losses of the chosen vehicle."""

    def __init__(self) -> None:
        self._by_name: Counter[str] = Counter()
        self._last_sequence: int | None = None
        self._recent: deque[bytes] = deque(maxlen=_MOST_OVERTAKEN)
        self._lost = 0
        self._first_ns: int | None = None
        self.heard_ns = 0
        """Arrival of the newest message; 0 before the first."""
        self.sent = 0

    def receive(self, name: str, message: ReceivedMessage, arrived_ns: int) -> None:
        """Count one message, and a gap in its 8-bit sequence number as losses (modulo 256).

        An overtaken message fills the gap that it left; a doubled one counts once. Some routers do
        not number the messages.
        """
        if message.packet not in self._recent:
            self._recent.append(message.packet)
            self._by_name[name] += 1
            self._count_gap(message.sequence)
        self._first_ns = arrived_ns if self._first_ns is None else self._first_ns
        self.heard_ns = arrived_ns

    def _count_gap(self, sequence: int) -> None:
        last = self._last_sequence
        ahead = 1 if last is None else (sequence - last) % 256
        if ahead >= 256 - _MOST_OVERTAKEN:
            self._lost = max(self._lost - 1, 0)
        elif ahead > 0:
            self._lost += ahead - 1
            self._last_sequence = sequence

    def new_sequence(self) -> None:
        """Accept any sequence number next: the sender has restarted."""
        self._last_sequence = None
        self._recent.clear()

    @property
    def messages_per_s(self) -> dict[str, float]:
        """Mean arrival rate by message name; empty before two arrivals."""
        span_ns = self.heard_ns - (self._first_ns or 0)
        counts = sorted(self._by_name.items()) if span_ns > 0 else ()
        return {name: count * NS_PER_S / span_ns for name, count in counts}

    @property
    def lost_fraction(self) -> float | None:
        """Share of the vehicle's messages that were lost; None before the first."""
        received = self._by_name.total()
        return self._lost / (self._lost + received) if received else None


def samples_of(
    packets: Iterable[ForwardedPacket],
) -> Iterator[tuple[tuple[Sample, ...], Telemetry]]:
    """Yield the samples that the guard took from recorded packets, and all readings after each."""
    codec, collector = Codec(source_system=0), TelemetryCollector()
    for arrived_ns, happened_ns, data in packets:
        samples: tuple[Sample, ...] = ()
        for message in codec.decode_datagram(data):
            if isinstance(message.body, Measurement):
                samples += collector.receive(message.body, arrived_ns, happened_ns)
        if samples:
            yield samples, collector.telemetry
