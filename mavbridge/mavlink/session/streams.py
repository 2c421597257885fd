"""Asking for telemetry at the rate of the action loop, and asking again when it stops coming."""

from dataclasses import dataclass

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.messages import CommandAck
from mavbridge.mavlink.codec.requests import AskCommand, AskStream, Request

_ACK_TIMEOUT_NS = 500 * NS_PER_MS
_ATTEMPTS = 4
_LOWEST_HZ = 25.0
_WATCH_NS = 2 * NS_PER_S
_ENOUGH = 0.7
"""Share of the granted rate below which somebody else has changed it (or it never came)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamGroup:
    """One quantity, the messages that carry it, best first, and its legacy stream."""

    messages: tuple[str, ...]
    stream: int
    rate_hz: float


def groups(*, state_hz: float, rc_hz: float) -> tuple[StreamGroup, ...]:
    """What the bridge needs."""
    return (
        StreamGroup(
            messages=("ATTITUDE_QUATERNION", "ATTITUDE"),
            stream=dialect.MAV_DATA_STREAM_EXTRA1,
            rate_hz=state_hz,
        ),
        StreamGroup(
            messages=("LOCAL_POSITION_NED",),
            stream=dialect.MAV_DATA_STREAM_POSITION,
            rate_hz=state_hz,
        ),
        StreamGroup(
            messages=("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU2"),
            stream=dialect.MAV_DATA_STREAM_RAW_SENSORS,
            rate_hz=state_hz,
        ),
        StreamGroup(
            messages=("RC_CHANNELS",), stream=dialect.MAV_DATA_STREAM_RC_CHANNELS, rate_hz=rc_hz
        ),
    )


class _Stream:
    """Negotiation of one group: which message, at which rate, by which request."""

    def __init__(self, group: StreamGroup) -> None:
        self.group = group
        self._choice = 0
        self.rate_hz = group.rate_hz
        self.attempts = 0
        self.is_settled = False
        self.received = 0

    @property
    def is_legacy(self) -> bool:
        """No message interval was accepted: REQUEST_DATA_STREAM it is."""
        return self._choice >= len(self.group.messages)

    def request(self) -> Request:
        """The next thing to ask."""
        self.attempts += 1
        if self.is_legacy:
            return AskStream(self.group.stream, round(self.group.rate_hz))
        name = self.group.messages[self._choice]
        interval_us = 1e6 / self.rate_hz
        return AskCommand(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, (message_id(name), interval_us))

    def accepted(self) -> None:
        self.is_settled = True
        self.attempts = 0

    def refused(self) -> None:
        """Half the rate, then the next message: "denied" may mean too fast or unknown."""
        self.attempts = 0
        if self.rate_hz / 2 >= _LOWEST_HZ:
            self.rate_hz /= 2
            return
        self.rate_hz = self.group.rate_hz
        self._choice += 1

    def unanswered(self) -> None:
        """The vehicle knows no such command."""
        self.attempts = 0
        self._choice = len(self.group.messages)


def message_id(name: str) -> int:
    """Number of a MAVLink message."""
    number: int = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
    return number


class StreamKeeper:
    """Keeps all groups flowing; one request is under way at a time, since acks carry no id."""

    def __init__(self, wanted: tuple[StreamGroup, ...]) -> None:
        self._streams = [_Stream(group) for group in wanted]
        self._by_message = {
            name: stream for stream in self._streams for name in stream.group.messages
        }
        self._pending: _Stream | None = None
        self._asked_ns = 0
        self._watched_ns: int | None = None
        self.renewals = 0
        """Times that a stream had to be asked for again."""

    @property
    def settled(self) -> bool:
        """Every group was granted at least once."""
        return all(stream.is_settled for stream in self._streams)

    def receive(self, name: str) -> None:
        """Count one message."""
        stream = self._by_message.get(name)
        if stream is not None:
            stream.received += 1

    def receive_ack(self, ack: CommandAck) -> None:
        """Take the vehicle's answer to the request under way."""
        if self._pending is None or ack.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            return
        if ack.result == dialect.MAV_RESULT_ACCEPTED:
            self._pending.accepted()
        elif ack.result not in (
            dialect.MAV_RESULT_TEMPORARILY_REJECTED,
            dialect.MAV_RESULT_IN_PROGRESS,
        ):
            self._pending.refused()
        self._pending = None

    def step(self, now_ns: int) -> Request | None:
        """The request that is due, if any."""
        self._watch(now_ns)
        if self._pending is not None:
            if now_ns - self._asked_ns < _ACK_TIMEOUT_NS:
                return None
            if self._pending.attempts >= _ATTEMPTS:
                self._pending.unanswered()
        self._pending = next((s for s in self._streams if not s.is_settled), None)
        if self._pending is None:
            return None
        self._asked_ns = now_ns
        request = self._pending.request()
        if isinstance(request, AskStream):  # never acknowledged
            self._pending.accepted()
            self._pending = None
        return request

    def _watch(self, now_ns: int) -> None:
        if not self.settled:
            self._watched_ns = None
            return
        if self._watched_ns is None:
            self._watched_ns = now_ns
        elif now_ns - self._watched_ns < _WATCH_NS:
            return
        else:
            span_s = (now_ns - self._watched_ns) / NS_PER_S
            for stream in self._streams:
                if stream.received < _ENOUGH * stream.rate_hz * span_s:
                    stream.is_settled = False
                    self.renewals += 1
            self._watched_ns = now_ns
        for stream in self._streams:
            stream.received = 0
