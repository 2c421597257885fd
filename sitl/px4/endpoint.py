"""One link of a PX4 vehicle: texts, events and streams.

Each control step, a stream is sent if its interval has passed and its topic is new. A stream that
is late by less than half an interval keeps its grid; a later one starts a new grid. So 200 Hz of a
250 Hz topic become 125 Hz, as measured.
"""

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_S
from sitl.link.server import MAX_STATUSTEXT, Endpoint, by_message
from sitl.px4.autopilot import Px4
from sitl.px4.commander import Event
from sitl.px4.messages import BUILDERS, BUILDERS_1_14, CURRENT_MODE, event_message, topic_version

NS_PER_US = 1000

_BOTH = by_message(SYSTEM_TIME=1.0, BATTERY_STATUS=0.5, HOME_POSITION=0.5, ESTIMATOR_STATUS=1.0)
_BOTH[CURRENT_MODE] = 0.5
ONBOARD_HZ: Mapping[int, float] = MappingProxyType(
    _BOTH
    | by_message(ATTITUDE=100.0, ATTITUDE_QUATERNION=50.0, GLOBAL_POSITION_INT=50.0)
    | by_message(HIGHRES_IMU=50.0, LOCAL_POSITION_NED=30.0, ODOMETRY=30.0, RC_CHANNELS=20.0)
    | by_message(TIMESYNC=10.0, ATTITUDE_TARGET=10.0, POSITION_TARGET_LOCAL_NED=10.0)
    | by_message(SERVO_OUTPUT_RAW=10.0, VFR_HUD=10.0, GPS_RAW_INT=5.0, EXTENDED_SYS_STATE=5.0)
    | by_message(SYS_STATUS=5.0)
)
"""Message rates on a link to a companion computer (mode Onboard)."""
GCS_HZ: Mapping[int, float] = MappingProxyType(
    _BOTH
    | by_message(ATTITUDE=50.0, ATTITUDE_QUATERNION=50.0, ATTITUDE_TARGET=50.0)
    | by_message(LOCAL_POSITION_NED=50.0, GLOBAL_POSITION_INT=50.0, SERVO_OUTPUT_RAW=50.0)
    | by_message(RC_CHANNELS=20.0, VFR_HUD=4.0, POSITION_TARGET_LOCAL_NED=1.5, GPS_RAW_INT=1.0)
    | by_message(EXTENDED_SYS_STATE=1.0, SYS_STATUS=1.0)
)
"""Message rates on a link to a ground station (mode Normal with the SITL script's additions)."""


@dataclass(slots=True, kw_only=True)
class _Stream:
    interval_us: int
    sent_us: int
    version: Hashable = None  # topic version when last sent


class Px4Endpoint(Endpoint[Px4]):
    """Link to a ground station, or to a companion computer, which gets other streams."""

    def __init__(self, ap: Px4, *, is_onboard: bool) -> None:
        self.heard: set[tuple[int, int]] = set()
        """Systems and components heard on this link."""
        default_hz = ONBOARD_HZ if is_onboard else GCS_HZ
        self._default_us = {key: round(1e6 / rate) for key, rate in default_hz.items()}
        self._text_id = self._event_sequence = 0
        super().__init__(ap, BUILDERS_1_14 if ap.config.px4_release == "1.14" else BUILDERS)

    def restart(self, ap: Px4) -> None:
        super().restart(ap)
        self.has_gcs = False  # heard a ground station's heartbeat; no text is sent before
        self._streams: dict[int, _Stream] = {}
        for message_id, interval_us in self._default_us.items():
            self._start(message_id, interval_us)
        self._heartbeat_due_ns = ap.now_ns
        self._looked_ns = ap.now_ns

    def step(self, now_ns: int) -> None:
        """Queue due messages: streams once per control step, parameters at every call."""
        ap = self._ap
        self._send_next_param(now_ns)
        if ap.now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns += NS_PER_S
            self.send_now(mav.MAVLINK_MSG_ID_HEARTBEAT)
        if ap.now_ns != self._looked_ns:
            self._looked_ns = ap.now_ns
            for message_id in self._due():
                self.send_now(message_id)

    def set_interval(self, message_id: int, interval_us: int) -> bool:
        """Apply MAV_CMD_SET_MESSAGE_INTERVAL: -1 stops, 0 restores the link's default."""
        if message_id not in self._builders or message_id == mav.MAVLINK_MSG_ID_HEARTBEAT:
            return False
        self._start(message_id, interval_us or self._default_us.get(message_id, -1))
        return True

    def interval_us(self, message_id: int) -> int:
        """Return the interval for MESSAGE_INTERVAL; -1: not streamed."""
        stream = self._streams.get(message_id)
        return -1 if stream is None else stream.interval_us

    def send_text(self, severity: int, text: str) -> None:
        """Send STATUSTEXT once a ground station is known; number the chunks of a long text."""
        if not self.has_gcs:
            return
        data = text.encode("ascii", "replace")
        if len(data) <= MAX_STATUSTEXT:
            self.send(mav.MAVLink_statustext_message(severity, data))
            return
        self._text_id = self._text_id % 65535 + 1
        for index, start in enumerate(range(0, len(data) + 1, MAX_STATUSTEXT)):
            chunk = data[start : start + MAX_STATUSTEXT]
            self.send(mav.MAVLink_statustext_message(severity, chunk, self._text_id, index))

    def send_event(self, event: Event) -> None:
        self._event_sequence = (self._event_sequence + 1) % 65536
        self.send(event_message(event, self._event_sequence))

    def _start(self, message_id: int, interval_us: int) -> None:
        if interval_us < 0:
            self._streams.pop(message_id, None)
        else:
            sent_us = self._ap.now_ns // NS_PER_US
            self._streams[message_id] = _Stream(interval_us=interval_us, sent_us=sent_us)

    def _due(self) -> list[int]:
        """Return the ids of the messages whose interval has passed and whose topic is new."""
        now_us, ready = self._ap.now_ns // NS_PER_US, []
        for message_id, stream in self._streams.items():
            interval_us = stream.interval_us
            if now_us - stream.sent_us < interval_us:
                continue
            if (version := topic_version(message_id, self._ap)) == stream.version:
                continue
            is_on_grid = now_us - stream.sent_us < 1.5 * interval_us
            stream.sent_us = stream.sent_us + interval_us if is_on_grid else now_us
            stream.version = version
            ready.append(message_id)
        return ready
