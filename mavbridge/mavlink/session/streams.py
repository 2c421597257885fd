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
    is_optional: bool = False
    """Nothing waits for it: a vehicle that does not grant it is flown without."""


RC_CHANNELS_HZ = 1000 / 17
"""RC_CHANNELS for the echo check, which needs 20 Hz or more: every 17 ms (ArduPilot counts in whole
ms), so that no usual rate of a joystick (10, 20, 25, 50 Hz) is in step with it and stays unseen
between two samples. Costs 3.2 kB/s."""
LANDED_HZ, ESTIMATOR_HZ, SYSTEM_HZ = 5.0, 5.0, 2.0
HEARTBEAT_HZ = 10.0
"""Shows arming and a change of mode within 100 ms where one packet is lost (at 1 Hz within 1 s).
ArduPilot grants it, PX4 does not."""


def telemetry_streams(*, state_hz: float, is_px4: bool) -> tuple[StreamGroup, ...]:
    """The telemetry that the bridge needs, then what it also watches."""
    attitude, imu = ("ATTITUDE_QUATERNION", "ATTITUDE"), ("HIGHRES_IMU", "RAW_IMU", "SCALED_IMU2")
    return (
        StreamGroup(attitude, dialect.MAV_DATA_STREAM_EXTRA1, state_hz),
        StreamGroup(("LOCAL_POSITION_NED",), dialect.MAV_DATA_STREAM_POSITION, state_hz),
        StreamGroup(imu, dialect.MAV_DATA_STREAM_RAW_SENSORS, state_hz),
        StreamGroup(("RC_CHANNELS",), dialect.MAV_DATA_STREAM_RC_CHANNELS, RC_CHANNELS_HZ),
        _optional("SYS_STATUS", SYSTEM_HZ),
        _optional("EXTENDED_SYS_STATE", LANDED_HZ),
        _optional("ESTIMATOR_STATUS" if is_px4 else "EKF_STATUS_REPORT", ESTIMATOR_HZ),
        *(() if is_px4 else (_optional("HEARTBEAT", HEARTBEAT_HZ),)),
    )


def _optional(message: str, rate_hz: float) -> StreamGroup:
    """Group of one message; its legacy stream, which would also set other messages, is not used."""
    return StreamGroup((message,), 0, rate_hz, is_optional=True)


class _Stream:
    """Negotiation of one group: the message, its rate, and the kind of request."""

    def __init__(self, group: StreamGroup) -> None:
        self.group = group
        self.rate_hz = group.rate_hz
        self.attempts = 0
        self.is_settled = False
        self.is_given_up = False
        """An optional group that the vehicle does not grant."""
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
        if self.group.is_optional:
            self._give_up()
            return
        if self.rate_hz / 2 >= _LOWEST_HZ:
            self.rate_hz /= 2
            return
        self.rate_hz = self.group.rate_hz
        self._choice += 1

    def give_up_intervals(self) -> None:
        """The vehicle does not answer SET_MESSAGE_INTERVAL."""
        self.attempts = 0
        self._choice = len(self.group.messages)
        if self.group.is_optional:
            self._give_up()

    def _give_up(self) -> None:
        self.is_settled = self.is_given_up = True


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
        """Every group that is needed is granted."""
        return all(stream.is_settled or stream.group.is_optional for stream in self._streams)

    def receive(self, name: str) -> None:
        """Count one message."""
        if (stream := self._by_message.get(name)) is not None:
            stream.received += 1

    def receive_ack(self, ack: CommandAck) -> None:
        """Take the vehicle's answer to the open request."""
        if self._pending is None or ack.command != dialect.MAV_CMD_SET_MESSAGE_INTERVAL:
            return
        if ack.result in _UNDECIDED:
            return  # asked again as if there were no answer
        if ack.result == dialect.MAV_RESULT_ACCEPTED:
            self._pending.accept()
        else:
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
                is_slow = stream.received < _ENOUGH * stream.rate_hz * span_s
                if is_slow and not stream.is_given_up:
                    stream.is_settled = False
                    self.renewals += not stream.group.is_optional
        self._window_ns = now_ns
        for stream in self._streams:
            stream.received = 0
