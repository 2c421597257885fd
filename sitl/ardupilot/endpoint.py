"""One link of an ArduPilot vehicle: message intervals with its rounding, caps and buckets."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.messages import BUILDERS
from sitl.clock import NS_PER_MS, NS_PER_S
from sitl.link.endpoint import MAX_STATUSTEXT, Endpoint
from sitl.vehicle.conditions import NOMINAL, Conditions

HEARTBEAT_INTERVAL_MS = 1000
MAX_INTERVAL_US = 60_000_000
MAX_DISTINCT_INTERVALS = 10
TIMESYNC_PERIOD_NS = 10 * NS_PER_S
PARAM_SLOWDOWN = 4  # factor on all intervals while a parameter list is being sent

STREAM_GROUPS: dict[int, tuple[int, ...]] = {
    mav.MAV_DATA_STREAM_RAW_SENSORS: (mav.MAVLINK_MSG_ID_RAW_IMU, mav.MAVLINK_MSG_ID_SCALED_IMU2),
    mav.MAV_DATA_STREAM_EXTENDED_STATUS: (
        mav.MAVLINK_MSG_ID_SYS_STATUS,
        mav.MAVLINK_MSG_ID_GPS_RAW_INT,
    ),
    mav.MAV_DATA_STREAM_RC_CHANNELS: (
        mav.MAVLINK_MSG_ID_RC_CHANNELS,
        mav.MAVLINK_MSG_ID_SERVO_OUTPUT_RAW,
    ),
    mav.MAV_DATA_STREAM_POSITION: (
        mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    ),
    mav.MAV_DATA_STREAM_EXTRA1: (mav.MAVLINK_MSG_ID_ATTITUDE,),
    mav.MAV_DATA_STREAM_EXTRA2: (mav.MAVLINK_MSG_ID_VFR_HUD,),
    mav.MAV_DATA_STREAM_EXTRA3: (
        mav.MAVLINK_MSG_ID_SYSTEM_TIME,
        mav.MAVLINK_MSG_ID_BATTERY_STATUS,
        mav.MAVLINK_MSG_ID_EKF_STATUS_REPORT,
    ),
}


@dataclass(slots=True, kw_only=True)
class _Stream:
    interval_ms: int
    due_ns: int  # next slot on the stream's own grid
    late_ns: int = 0  # delay of the next message after its slot


class ArduPilotStreams:
    """The message intervals of one link; stamps are the vehicle's clock, intervals whole ms.

    MESSAGE_INTERVAL does not report what the conditions add to them (a slow link, jitter, phases),
    as on the firmware.
    """

    def __init__(
        self, known: Collection[int], now_ns: int, conditions: Conditions = NOMINAL
    ) -> None:
        self._known = known
        self._slowdown_ms = conditions.stream_slowdown_ms
        self._jitter_ns = conditions.stream_jitter_ms * NS_PER_MS
        self._phase_spread = conditions.stream_phase_spread
        self._random = np.random.Generator(np.random.PCG64((conditions.seed, 5)))
        self._streams: dict[int, _Stream] = {}
        self._start(mav.MAVLINK_MSG_ID_HEARTBEAT, HEARTBEAT_INTERVAL_MS, now_ns)

    def set_interval(
        self, message_id: int, interval_us: int, *, loop_hz: float, now_ns: int
    ) -> str | None:
        """Apply MAV_CMD_SET_MESSAGE_INTERVAL: -1 stops, 0 restores the default.

        Returns:
            None if accepted; else the reason, and the old interval is kept.
        """
        if message_id not in self._known:
            return f"No ap_message for mavlink id ({message_id})"
        interval_ms = max(1, min(interval_us, MAX_INTERVAL_US) // 1000) if interval_us > 0 else 0
        if interval_us == 0 and message_id == mav.MAVLINK_MSG_ID_HEARTBEAT:
            interval_ms = HEARTBEAT_INTERVAL_MS
        if 0 < interval_ms < shortest_ms(loop_hz):
            return f"Requested rate for message ID {message_id} too fast. Increase SCHED_LOOP_RATE"
        self._start(message_id, interval_ms, now_ns)
        return None

    def set_group(self, group: int, rate_hz: int, *, loop_hz: float, now_ns: int) -> None:
        """Apply REQUEST_DATA_STREAM; it overrules earlier intervals. Rate 0 stops the group."""
        interval_ms = max(1000 // rate_hz, shortest_ms(loop_hz)) if rate_hz > 0 else 0
        for one in STREAM_GROUPS if group == mav.MAV_DATA_STREAM_ALL else (group,):
            for message_id in STREAM_GROUPS.get(one, ()):
                self._start(message_id, interval_ms, now_ns)

    def interval_us(self, message_id: int) -> int:
        """The interval that MESSAGE_INTERVAL reports: 0 = unknown message, -1 = not streamed."""
        if message_id not in self._known:
            return 0
        stream = self._streams.get(message_id)
        return stream.interval_ms * 1000 if stream else -1

    def due(self, now_ns: int, slowdown: int) -> list[int]:
        """Ids of the messages to send now; missed slots are dropped, so a late one is sent once."""
        ready = [
            key for key, stream in self._streams.items() if now_ns >= stream.due_ns + stream.late_ns
        ]
        for message_id in ready:
            stream = self._streams[message_id]
            period_ns = (stream.interval_ms + self._slowdown_ms) * NS_PER_MS * slowdown
            stream.due_ns += period_ns * ((now_ns - stream.due_ns) // period_ns + 1)
            stream.late_ns = self._random_ns(self._jitter_ns)
        return ready

    def _random_ns(self, most_ns: float) -> int:
        return int(self._random.uniform(0.0, most_ns)) if most_ns else 0

    def _start(self, message_id: int, interval_ms: int, now_ns: int) -> None:
        self._streams.pop(message_id, None)
        if interval_ms > 0:
            # The firmware keeps ten distinct intervals per link; an eleventh joins the nearest.
            taken = {stream.interval_ms for stream in self._streams.values()}
            if interval_ms not in taken and len(taken) >= MAX_DISTINCT_INTERVALS:
                interval_ms = min(taken, key=lambda other: abs(other - interval_ms))
            period_ns = (interval_ms + self._slowdown_ms) * NS_PER_MS
            due_ns = now_ns + period_ns - self._random_ns(self._phase_spread * period_ns)
            self._streams[message_id] = _Stream(interval_ms=interval_ms, due_ns=due_ns)


def shortest_ms(loop_hz: float) -> int:
    """Shortest interval: 0.8 of the main loop's rate, in whole milliseconds; 3 ms at 400 Hz."""
    return int(1000.0 / (0.8 * max(50.0, loop_hz)))


class ArduPilotEndpoint(Endpoint[ArduCopter]):
    """Intervals belong to the link, not to the sender that requested them; two ground stations on
    one link share them."""

    def __init__(self, ap: ArduCopter) -> None:
        super().__init__(ap, BUILDERS)

    def restart(self, ap: ArduCopter) -> None:
        """Begin again with a vehicle that has just booted."""
        super().restart(ap)
        self._streams = ArduPilotStreams(BUILDERS, ap.now_ns, ap.config.conditions)
        self._timesync_due_ns = ap.now_ns + TIMESYNC_PERIOD_NS

    def step(self, _now_ns: int) -> None:
        """Queue what is due by the vehicle's clock."""
        now_ns = self._ap.now_ns
        self._send_next_param(now_ns)
        for message_id in self._streams.due(now_ns, PARAM_SLOWDOWN if self._queued_params else 1):
            self.send_now(message_id)
        if now_ns >= self._timesync_due_ns:
            self._timesync_due_ns += TIMESYNC_PERIOD_NS
            uptime_ns = self._ap.uptime_ns
            self.send(mav.MAVLink_timesync_message(0, uptime_ns + self._ap.system_id))

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

    def interval_us(self, message_id: int) -> int:
        """The interval that MESSAGE_INTERVAL reports."""
        return self._streams.interval_us(message_id)

    def send_text(self, severity: int, text: str) -> None:
        """Send STATUSTEXT, in as many messages as the text needs."""
        for start in range(0, len(text), MAX_STATUSTEXT):
            chunk = text[start : start + MAX_STATUSTEXT].encode("ascii", "replace")
            self.send(mav.MAVLink_statustext_message(severity, chunk))
