"""One MAVLink link of the vehicle, without I/O: bytes in, messages out, messages in, bytes out."""

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.autopilot import Autopilot
from sitl.ardupilot.link.messages import BUILDERS
from sitl.ardupilot.link.streams import PARAM_SLOWDOWN, Streams
from sitl.clock import NS_PER_S
from sitl.link.endpoint import MAX_STATUSTEXT, VehicleEndpoint

TIMESYNC_PERIOD_NS = 10 * NS_PER_S


class MavlinkEndpoint(VehicleEndpoint[Autopilot]):
    """Message intervals and the parameter list of one link.

    Intervals belong to the link, not to the sender that requested them; two ground stations on one
    link share them.
    """

    def __init__(self, ap: Autopilot) -> None:
        super().__init__(BUILDERS, "MAV_SYSID", ap.config.signing)
        self.reboot_requested = False
        self.restart(ap)

    def restart(self, ap: Autopilot) -> None:
        """Begin again with a vehicle that has just booted; framing and sequence numbers go on."""
        self.reboot_requested = False
        self._serve(ap)
        self._streams = Streams(BUILDERS, ap.now_ns, ap.config.conditions)
        self._timesync_due_ns = ap.now_ns + TIMESYNC_PERIOD_NS

    def step(self) -> None:
        """Queue what is due by the vehicle's clock."""
        now_ns = self._ap.now_ns
        self._send_next_param(now_ns)
        for message_id in self._streams.due(now_ns, PARAM_SLOWDOWN if self._queued_params else 1):
            self.send_now(message_id)
        if now_ns >= self._timesync_due_ns:
            self._timesync_due_ns += TIMESYNC_PERIOD_NS
            system_id = self._ap.params.integer("MAV_SYSID")
            self.send(mav.MAVLink_timesync_message(0, self._ap.uptime_ns + system_id))

    def set_interval(self, message_id: int, interval_us: int) -> str | None:
        """Change a stream; returns the reason if refused."""
        loop_hz = self._ap.params["SCHED_LOOP_RATE"]
        return self._streams.set_interval(
            message_id, interval_us, loop_hz=loop_hz, now_ns=self._ap.now_ns
        )

    def set_group(self, group: int, rate_hz: int) -> None:
        """Change the group of streams of a REQUEST_DATA_STREAM; rate 0 stops it."""
        loop_hz = self._ap.params["SCHED_LOOP_RATE"]
        self._streams.set_group(group, rate_hz, loop_hz=loop_hz, now_ns=self._ap.now_ns)

    def send_interval(self, message_id: int) -> None:
        """Send MESSAGE_INTERVAL."""
        interval_us = self._streams.interval_us(message_id)
        self.send(mav.MAVLink_message_interval_message(message_id, interval_us))

    def send_text(self, severity: int, text: str) -> None:
        """Send STATUSTEXT, in as many messages as the text needs."""
        for start in range(0, len(text), MAX_STATUSTEXT):
            chunk = text[start : start + MAX_STATUSTEXT].encode("ascii", "replace")
            self.send(mav.MAVLink_statustext_message(severity, chunk))
