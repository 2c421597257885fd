"""Requests telemetry at the rate of the action loop, and again whenever it slows down."""

from typing import NamedTuple

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.mavlink.codec.messages import CommandAck, CommandRequest, Request, StreamRequest

_ACK_TIMEOUT_NS = 500 * NS_PER_MS
_ATTEMPTS = 4
_LOWEST_HZ = 25.0
_WATCH_NS = 2 * NS_PER_S
_UNDECIDED = (dialect.MAV_RESULT_TEMPORARILY_REJECTED, dialect.MAV_RESULT_IN_PROGRESS)
_ENOUGH = 0.7
"""Share of the granted rate below which another station is assumed to have changed it."""


class StreamGroup(NamedTuple):
    """One quantity: the messages that carry it, best first, and its legacy stream."""

    messages: tuple[str, ...]
    stream: int
    rate_hz: float


def telemetry_streams(*, state_hz: float, rc_hz: float) -> tuple[StreamGroup, ...]:
    """The telemetry that the bridge needs."""
    attitude, imu = ("ATTITUDE_QUATERNION", "ATTITUDE"), ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU2")
    return (
        StreamGroup(attitude, dialect.MAV_DATA_STREAM_EXTRA1, state_hz),
        StreamGroup(("LOCAL_POSITION_NED",), dialect.MAV_DATA_STREAM_POSITION, state_hz),
        StreamGroup(imu, dialect.MAV_DATA_STREAM_RAW_SENSORS, state_hz),
        StreamGroup(("RC_CHANNELS",), dialect.MAV_DATA_STREAM_RC_CHANNELS, rc_hz),
    )


class _Stream:
    """Negotiation of one group: the message, its rate, and the kind of request."""

    def __init__(self, group: StreamGroup) -> None:
        self.group = group
        self.rate_hz = group.rate_hz
        self.attempts = 0
        self.is_settled = False
        self.received = 0
        self._choice = 0

    def request(self) -> Request:
        """The next request to send: REQUEST_DATA_STREAM once no message interval was accepted."""
        self.attempts += 1
        if self._choice >= len(self.group.messages):
            return StreamRequest(self.group.stream, round(self.group.rate_hz))
        number = message_id(self.group.messages[self._choice])
        return CommandRequest(dialect.MAV_CMD_SET_MESSAGE_INTERVAL, (number, 1e6 / self.rate_hz))

    def accept(self) -> None:
        self.is_settled, self.attempts = True, 0

    def refuse(self) -> None:
        """Half the rate, then the next message: "denied" may mean too fast or unknown."""
        self.attempts = 0
        if self.rate_hz / 2 >= _LOWEST_HZ:
            self.rate_hz /= 2
            return
        self.rate_hz = self.group.rate_hz
        self._choice += 1

    def give_up_intervals(self) -> None:
        """The vehicle does not answer SET_MESSAGE_INTERVAL."""
        self.attempts = 0
        self._choice = len(self.group.messages)


def message_id(name: str) -> int:
    """Number of a MAVLink message."""
    number: int = getattr(dialect, f"MAVLINK_MSG_ID_{name}")
    return number


class StreamRequester:
    """Keeps all groups coming; one request is open at a time, since acks carry no message id."""

    def __init__(self, wanted: tuple[StreamGroup, ...]) -> None:
        self._streams = [_Stream(group) for group in wanted]
        self._by_message = {
            name: stream for stream in self._streams for name in stream.group.messages
        }
        self._pending: _Stream | None = None
        self._requested_ns = 0
        self._window_ns: int | None = None
        """Start of the window in which messages are counted; None while requests are open."""
        self.renewals = 0

    @property
    def is_settled(self) -> bool:
        """Every group is granted."""
        return all(stream.is_settled for stream in self._streams)

    def receive(self, name: str) -> None:
        """Count one message."""
        if (stream := self._by_message.get(name)) is not None:
            stream.received += 1

    def receive_ack(self, ack: CommandAck) -> None:
        """Take the vehicle's answer to the open request."""
        if self._pending is None or ack.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            return
        if ack.result == dialect.MAV_RESULT_ACCEPTED:
            self._pending.accept()
        elif ack.result not in _UNDECIDED:
            self._pending.refuse()
        self._pending = None

    def step(self, now_ns: int) -> Request | None:
        """The request that is due, if any."""
        self._check_rates(now_ns)
        if self._pending is not None:
            if now_ns - self._requested_ns < _ACK_TIMEOUT_NS:
                return None
            if self._pending.attempts >= _ATTEMPTS:
                self._pending.give_up_intervals()
        self._pending = next((s for s in self._streams if not s.is_settled), None)
        if self._pending is None:
            return None
        self._requested_ns = now_ns
        request = self._pending.request()
        if isinstance(request, StreamRequest):  # never acknowledged
            self._pending.accept()
            self._pending = None
        return request

    def _check_rates(self, now_ns: int) -> None:
        if not self.is_settled:
            self._window_ns = None
            return
        if self._window_ns is not None:
            if now_ns - self._window_ns < _WATCH_NS:
                return
            span_s = (now_ns - self._window_ns) / NS_PER_S
            for stream in self._streams:
                if stream.received < _ENOUGH * stream.rate_hz * span_s:
                    stream.is_settled = False
                    self.renewals += 1
        self._window_ns = now_ns
        for stream in self._streams:
            stream.received = 0
