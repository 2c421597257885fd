"""One link of a PX4 vehicle: its messages, in the units that PX4 uses, texts, events and streams.

Each control step, a stream is sent if its interval has passed and its topic is new. A stream that
is late by less than half an interval keeps its grid; a later one starts a new grid. So 200 Hz of a
250 Hz topic become 125 Hz, as measured.

No dialect of pymavlink has EVENT(410), so it is packed here by its definition in MAVLink's common
set.
"""

import math
import struct
from collections.abc import Hashable, Mapping
from types import MappingProxyType

import numpy as np
from pymavlink.dialects.v20 import development as mav

from sitl.clock import NS_PER_MS, NS_PER_US
from sitl.link.server import Endpoint, Stream, by_message
from sitl.link.telemetry import Fields, Message, Telemetry
from sitl.px4.autopilot import Px4
from sitl.px4.commander import Event
from sitl.px4.modes import Px4Mode
from sitl.vehicle.config import Px4Release
from sitl.vehicle.firmware import VelocitySetpoint

CURRENT_MODE = mav.MAVLINK_MSG_ID_CURRENT_MODE
_EVENT, _EVENT_CRC_EXTRA = struct.Struct("<IIHBBB40s"), 160
_EVENT_LEVELS = 0x66  # for peers and for the vehicle's own log: info

_FIRMWARE_VERSIONS: dict[Px4Release, int] = {
    "1.17": 0x011100FF,
    "1.18": 0x01120080,  # beta
}

_SENSORS_PRESENT, _SENSORS_ENABLED, _SENSORS_HEALTHY = 0x200C02F, 0x201C02F, 0x320C83F
_ESTIMATOR_WITHOUT_POSITION = 0xE5
_ESTIMATOR_WITH_POSITION, _ESTIMATOR_ON_GROUND = 0x37F, 0x3FF


class EventMessage(mav.MAVLink_message):  # type: ignore[misc]  # the library has no types
    """EVENT(410), without arguments."""

    def __init__(self, event: Event, sequence: int) -> None:
        super().__init__(410, "EVENT")
        head = (event.number, event.uptime_ms, sequence)
        self._event = _EVENT.pack(*head, 0, 0, _EVENT_LEVELS, b"")

    def pack(self, sender: Message, force_mavlink1: bool = False) -> bytes:
        return bytes(self._pack(sender, _EVENT_CRC_EXTRA, self._event, force_mavlink1))


class Px4Telemetry(Telemetry[Px4]):
    """PX4's messages, at the default home of its SIH."""

    lat_deg, lon_deg, alt_m = 47.397743, 8.545594, 489.4
    capabilities = 0xE8FF
    dialect = mav

    @property
    def version(self) -> int:
        return _FIRMWARE_VERSIONS[self.ap.config.px4_release]

    def heartbeat(self) -> Fields:
        """Once a second, so a short change, even an arming, may never show."""
        ap, base_mode = self.ap, self.ap.mode.base_flags
        if ap.armed:
            base_mode |= mav.MAV_MODE_FLAG_SAFETY_ARMED
        if ap.in_failsafe:
            status = mav.MAV_STATE_CRITICAL
        elif ap.armed:
            status = mav.MAV_STATE_ACTIVE
        else:
            status = mav.MAV_STATE_STANDBY if ap.can_arm() else mav.MAV_STATE_UNINIT
        kind = (mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_PX4)
        return (*kind, base_mode, ap.mode.custom_mode, status, 3)

    def current_mode(self) -> Fields:
        mode = self.ap.mode
        return (mode.standard, mode.custom_mode, self.ap.intended.custom_mode)

    def sys_status(self) -> Fields:
        """PREARM_CHECK, never present, is healthy if health allows arming."""
        sticks = mav.MAV_SYS_STATUS_SENSOR_RC_RECEIVER if self.ap.stick_input.valid else 0
        healthy = _SENSORS_HEALTHY | sticks
        if self.ap.armed or self.ap.can_arm():
            healthy |= mav.MAV_SYS_STATUS_PREARM_CHECK
        present = _SENSORS_PRESENT | sticks
        return self._health(present=present, enabled=_SENSORS_ENABLED, healthy=healthy)

    def local_position_ned(self) -> Fields:
        """Without a position, zeros that nothing marks as invalid."""
        body = self.ap.sensed
        (north, east, down), (vn, ve, vd) = body.position_ned_m, body.velocity_ned_mps
        if not self.ap.position_ready:
            north = east = vn = ve = 0.0
        return (self.boot_ms, north, east, down, vn, ve, vd)

    def rc_channels(self) -> Fields | None:
        """A receiver's channels; MANUAL_CONTROL never shows here."""
        if (receiver_us := self.ap.receiver.channels_us) is None:
            return None
        channels = (*receiver_us, *[65535] * 18)[:18]
        return (self.boot_ms, len(receiver_us), *channels, 100)

    def manual_control(self) -> Fields | None:
        """The chosen sticks, scaled in single precision and truncated."""
        if not self.ap.stick_input.valid:
            return None
        forward, right, throttle, yaw = map(np.float32, self.ap.stick_input.sticks)
        thousand, one, two = np.float32(1000.0), np.float32(1.0), np.float32(2.0)
        x, y, r = (int(value * thousand) for value in (forward, right, yaw))
        z = int((throttle + one) / two * thousand)
        return (self.ap.system_id, x, y, z, r, 0)

    def attitude_target(self) -> Fields:
        """Setpoints of the rate and attitude loops, in any mode."""
        flight = self.ap.flight
        return (self.boot_ms, 0, list(flight.attitude), *flight.rates_radps, flight.thrust)

    def position_target_local_ned(self) -> Fields:
        none, flight = [math.nan] * 3, self.ap.flight
        head = (self.boot_ms, mav.MAV_FRAME_LOCAL_NED, 0)
        turn = (math.nan, flight.yaw_rate_radps)
        return (*head, *none, *flight.velocity_ned_mps, *none, *turn)

    def estimator_status(self) -> Fields:
        """The only message with the validity of the horizontal position."""
        found = _ESTIMATOR_ON_GROUND if self.ap.landed else _ESTIMATOR_WITH_POSITION
        if not self.ap.position_ready:
            found = _ESTIMATOR_WITHOUT_POSITION
        if not self.ap.estimator_ready:
            found = 0
        return (self.boot_us, found, 0.02, 0.02, 0.02, 0.02, 0.0, 0.0, 0.2, 0.2)

    def extended_sys_state(self) -> Fields:
        mode = self.ap.mode
        state = self._landed_state(
            is_landing=mode is Px4Mode.AUTO_LAND, is_taking_off=mode is Px4Mode.AUTO_TAKEOFF
        )
        return (mav.MAV_VTOL_STATE_MC, state)


def topic_version(message_id: int, ap: Px4) -> Hashable:
    """Return a value that changes with each new sample of the topic; it bounds a stream's rate."""
    if message_id == mav.MAVLINK_MSG_ID_ATTITUDE_TARGET:
        sends_attitude = ap.mode is Px4Mode.OFFBOARD and not isinstance(
            ap.setpoint, VelocitySetpoint
        )
        return ap.setpoint_count if sends_attitude else _at_rate(ap, 8)
    if message_id == mav.MAVLINK_MSG_ID_MANUAL_CONTROL:
        return ap.stick_input.count
    if message_id == CURRENT_MODE:
        return ap.mode, ap.intended, _at_rate(ap, 500)
    return ap.uptime_ns


def _at_rate(ap: Px4, period_ms: int) -> int:
    """Return the version of a topic that is published with this period."""
    return ap.uptime_ns // (period_ms * NS_PER_MS)


HEARTBEAT_US = 1_000_000
DEFAULT_HZ: Mapping[int, float] = MappingProxyType(
    {CURRENT_MODE: 0.5}
    | by_message(ESTIMATOR_STATUS=1.0)
    | by_message(ATTITUDE=50.0, ATTITUDE_QUATERNION=50.0, ATTITUDE_TARGET=50.0)
    | by_message(LOCAL_POSITION_NED=50.0, GLOBAL_POSITION_INT=50.0, RC_CHANNELS=20.0)
    | by_message(POSITION_TARGET_LOCAL_NED=1.5, EXTENDED_SYS_STATE=1.0, SYS_STATUS=1.0)
)
"""Message rates without a request (mode Normal with the SITL script's additions)."""


class Px4Endpoint(Endpoint[Px4]):
    """Link of PX4, with its events."""

    def __init__(self, ap: Px4) -> None:
        self._default_us = {key: round(1e6 / rate) for key, rate in DEFAULT_HZ.items()}
        self._event_sequence = 0
        super().__init__(ap, Px4Telemetry(ap))
        self.has_gcs = False  # heard a ground station's heartbeat; no text is sent before
        heartbeat = Stream(interval_us=HEARTBEAT_US, due_ns=ap.now_ns)  # the first one at once
        self._streams[mav.MAVLINK_MSG_ID_HEARTBEAT] = heartbeat
        for message_id, interval_us in self._default_us.items():
            self._start(message_id, interval_us)

    def set_interval(self, message_id: int, interval_us: int) -> bool:
        """Apply MAV_CMD_SET_MESSAGE_INTERVAL: -1 stops, 0 restores the link's default."""
        if message_id not in self._telemetry.names or message_id == mav.MAVLINK_MSG_ID_HEARTBEAT:
            return False
        self._start(message_id, interval_us or self._default_us.get(message_id, -1))
        return True

    def send_text(self, severity: int, text: str) -> None:
        """Send STATUSTEXT once a ground station is known."""
        if self.has_gcs:
            super().send_text(severity, text)

    def send_event(self, event: Event) -> None:
        self._event_sequence = (self._event_sequence + 1) % 65536
        self.send(EventMessage(event, self._event_sequence))

    def _start(self, message_id: int, interval_us: int) -> None:
        if interval_us < 0:
            self._streams.pop(message_id, None)
        else:
            due_ns = self._ap.now_ns + interval_us * NS_PER_US
            self._streams[message_id] = Stream(interval_us=interval_us, due_ns=due_ns)

    def _due(self) -> list[int]:
        """Return the ids of the messages whose interval has passed and whose topic is new."""
        now_ns, ready = self._ap.now_ns, []
        for message_id, stream in self._streams.items():
            if now_ns < stream.due_ns:
                continue
            if (version := topic_version(message_id, self._ap)) == stream.version:
                continue
            interval_ns = stream.interval_us * NS_PER_US
            is_on_grid = now_ns - stream.due_ns < interval_ns / 2
            stream.due_ns = (stream.due_ns if is_on_grid else now_ns) + interval_ns
            stream.version = version
            ready.append(message_id)
        return ready
