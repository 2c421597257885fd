"""One MAVLink link of a PX4 vehicle, without I/O: streams, texts, events and parameters."""

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_S
from sitl.link.endpoint import MAX_STATUSTEXT, VehicleEndpoint
from sitl.px4.autopilot import Autopilot
from sitl.px4.events import Event
from sitl.px4.link.messages import BUILDERS, BUILDERS_1_14, event_message, topic_version
from sitl.px4.link.streams import GCS_HZ, ONBOARD_HZ, Streams

_NEVER_STREAMED = (mav.MAVLINK_MSG_ID_HEARTBEAT,)


class MavlinkEndpoint(VehicleEndpoint[Autopilot]):
    """A link to a ground station, or to a companion computer, which gets other streams."""

    def __init__(self, ap: Autopilot, *, is_onboard: bool) -> None:
        builders = BUILDERS_1_14 if ap.config.px4_release == "1.14" else BUILDERS
        super().__init__(builders, "MAV_SYS_ID", ap.config.signing)
        self.heard: set[tuple[int, int]] = set()
        """Systems and components that have sent on this link."""
        self._is_onboard = is_onboard
        self._text_id = self._event_sequence = 0
        self.restart(ap)

    def restart(self, ap: Autopilot) -> None:
        """Begin again with a vehicle that has just booted; framing and sequence numbers go on."""
        self._serve(ap)
        self.has_gcs = False
        """A ground station's heartbeat has come; without one no text is sent."""
        defaults = ONBOARD_HZ if self._is_onboard else GCS_HZ
        self._streams = Streams(defaults, ap.config.link_bytes_ps, ap.now_ns)
        self._heartbeat_due_ns = ap.now_ns
        self._looked_ns = ap.now_ns

    def step(self, now_ns: int) -> None:
        """Queue what is due; streams are looked at once a control step, sticks at every call."""
        ap = self._ap
        self._send_next_param(now_ns)
        if ap.now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns += NS_PER_S
            self.send_now(mav.MAVLINK_MSG_ID_HEARTBEAT)
        if ap.now_ns != self._looked_ns:
            self._looked_ns = ap.now_ns
            for message_id in self._streams.due(ap.now_ns, lambda key: topic_version(key, ap)):
                self.send_now(message_id)

    def set_interval(self, message_id: int, interval_us: int) -> bool:
        """Change a stream; False for a message that cannot be streamed."""
        if message_id not in self._builders or message_id in _NEVER_STREAMED:
            return False
        self._streams.set_interval(message_id, interval_us, self._ap.now_ns)
        return True

    def send_interval(self, message_id: int) -> None:
        """Send MESSAGE_INTERVAL."""
        interval_us = self._streams.interval_us(message_id)
        self.send(mav.MAVLink_message_interval_message(message_id, interval_us))

    def send_text(self, severity: int, text: str) -> None:
        """Send STATUSTEXT once a ground station is known, a long one in numbered chunks."""
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
        """Send EVENT, whoever listens."""
        self._event_sequence = (self._event_sequence + 1) % 65536
        self.send(event_message(event, self._event_sequence))

    def _kind(self, name: str) -> int:
        """INT32 or REAL32."""
        return self._ap.params.kind(name)
