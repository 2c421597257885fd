"""One link of an ArduPilot vehicle: its messages and their intervals.

As measured on ArduCopter 4.7, intervals are rounded and capped, and positions are withheld until
the estimator has one.
"""

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.guided import Submode
from sitl.clock import NS_PER_MS, NS_PER_US, next_slot_ns
from sitl.link.server import Endpoint, Stream
from sitl.link.telemetry import Fields, Telemetry, flags
from sitl.vehicle.config import ArduPilotRelease

_SENSORS = flags(
    "MAV_SYS_STATUS_",
    "SENSOR_3D_GYRO SENSOR_3D_ACCEL SENSOR_3D_MAG SENSOR_ABSOLUTE_PRESSURE SENSOR_GPS "
    "SENSOR_ANGULAR_RATE_CONTROL SENSOR_ATTITUDE_STABILIZATION AHRS SENSOR_BATTERY",
)
_FIRMWARE_VERSIONS: dict[ArduPilotRelease, int] = {
    "4.6": 4 << 24 | 6 << 16 | 3 << 8 | mav.FIRMWARE_VERSION_TYPE_OFFICIAL,
    "4.7-dev": 4 << 24 | 7 << 16 | mav.FIRMWARE_VERSION_TYPE_DEV,
}
_BASE_MODE = flags("MAV_MODE_FLAG_", "CUSTOM_MODE_ENABLED STABILIZE_ENABLED MANUAL_INPUT_ENABLED")
_EKF_VERTICAL = mav.EKF_ATTITUDE | mav.EKF_VELOCITY_VERT | mav.EKF_POS_VERT_ABS
_EKF_HORIZONTAL = flags(
    "EKF_", "VELOCITY_HORIZ POS_HORIZ_REL POS_HORIZ_ABS PRED_POS_HORIZ_REL PRED_POS_HORIZ_ABS"
)
_VELOCITY_ONLY = 3079  # POSITION_TARGET_LOCAL_NED.type_mask: velocity and acceleration only
_POSITION_ONLY = 3576  # type_mask: position only


class ArduPilotTelemetry(Telemetry[ArduCopter]):
    """ArduPilot's messages, at the default home of its SITL."""

    lat_deg, lon_deg, alt_m = -35.3632621, 149.1652374, 584.0
    capabilities = flags(
        "MAV_PROTOCOL_CAPABILITY_",
        "PARAM_FLOAT MISSION_INT COMMAND_INT MAVLINK2 SET_ATTITUDE_TARGET "
        "SET_POSITION_TARGET_LOCAL_NED",
    )
    """Without FTP, so that clients fetch parameters with PARAM_REQUEST_LIST."""

    @property
    def version(self) -> int:
        return _FIRMWARE_VERSIONS[self.ap.config.ardupilot_release]

    def heartbeat(self) -> Fields:
        """Its state is CRITICAL while a failsafe is active."""
        ap, base_mode, status = self.ap, _BASE_MODE, mav.MAV_STATE_STANDBY
        if ap.armed:
            base_mode |= mav.MAV_MODE_FLAG_SAFETY_ARMED
            status = mav.MAV_STATE_ACTIVE
        if ap.radio_failsafe.active:
            status = mav.MAV_STATE_CRITICAL
        kind = (mav.MAV_TYPE_QUADROTOR, mav.MAV_AUTOPILOT_ARDUPILOTMEGA)
        return (*kind, base_mode, int(ap.mode), status, 3)

    def sys_status(self) -> Fields:
        """PREARM_CHECK is healthy if only mode and sticks can still refuse arming."""
        ap, faults = self.ap, 0
        present = _SENSORS | mav.MAV_SYS_STATUS_PREARM_CHECK
        present |= mav.MAV_SYS_STATUS_SENSOR_RC_RECEIVER if ap.rc.found else 0
        if not ap.armed and ap.prearm_refusal() is not None:
            faults |= mav.MAV_SYS_STATUS_PREARM_CHECK
        if ap.radio_failsafe.active:
            faults |= mav.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
        return self._health(present=present, enabled=present, healthy=present & ~faults)

    def local_position_ned(self) -> Fields | None:
        if not self.ap.position_ready:
            return None
        body = self.ap.sensed
        return (self.boot_ms, *body.position_ned_m, *body.velocity_ned_mps)

    def rc_channels(self) -> Fields:
        """Channel values after overrides."""
        rc = self.ap.rc
        return (self.boot_ms, rc.channel_count, *rc.channels_us, 0, 0, 255)

    def ekf_status_report(self) -> Fields:
        """The attitude flags from the start, the others with a position."""
        found, ap = mav.EKF_UNINITIALIZED, self.ap
        if ap.estimator_ready:
            found = _EKF_VERTICAL | (0 if ap.position_ready else mav.EKF_CONST_POS_MODE)
        if ap.position_ready:
            found |= _EKF_HORIZONTAL
        return (found, 0.01, 0.01, 0.01, 0.01, 0.0)

    def extended_sys_state(self) -> Fields:
        ap = self.ap
        is_taking_off = ap.guided is not None and ap.guided.is_taking_off(ap.sensed)
        state = self._landed_state(is_landing=ap.mode.lands, is_taking_off=is_taking_off)
        return (mav.MAV_VTOL_STATE_UNDEFINED, state)

    def attitude_target(self) -> Fields:
        """The controller's shaped target, not the received setpoint, and the thrust before the
        lean boost."""
        attitude, rate_radps = self.ap.control.target
        return (self.boot_ms, 0, attitude, *rate_radps, self.ap.control.thrust)

    def position_target_local_ned(self) -> Fields | None:
        """The setpoint that GUIDED follows, in NED axes; None for attitudes or other modes."""
        guided = self.ap.guided if self.ap.mode is Mode.GUIDED else None
        if guided is None or guided.submode is Submode.ATTITUDE:
            return None
        mask = _POSITION_ONLY if guided.submode is Submode.TAKEOFF else _VELOCITY_ONLY
        zeros = [0.0] * 3  # the position is zero even during a takeoff, as in the firmware
        velocity_mps = guided.velocity.velocity_ned_mps
        head = (self.boot_ms, mav.MAV_FRAME_LOCAL_NED, mask)
        return (*head, *zeros, *velocity_mps, *zeros, 0.0, 0.0)


HEARTBEAT_INTERVAL_MS = 1000
SHORTEST_INTERVAL_MS = 3  # 1 / (0.8 * SCHED_LOOP_RATE) in whole milliseconds, at 400 Hz
MAX_INTERVAL_US = 60_000_000


class ArduPilotEndpoint(Endpoint[ArduCopter]):
    """Link whose message intervals, in whole ms, are shared by all of its senders."""

    def __init__(self, ap: ArduCopter) -> None:
        super().__init__(ap, ArduPilotTelemetry(ap))
        self._conditions = ap.config.conditions
        self._random = np.random.Generator(np.random.PCG64((self._conditions.seed, 5)))
        self._start(mav.MAVLINK_MSG_ID_HEARTBEAT, HEARTBEAT_INTERVAL_MS)

    def set_interval(self, message_id: int, interval_us: int) -> bool:
        """Apply MAV_CMD_SET_MESSAGE_INTERVAL: -1 stops, 0 restores the default."""
        interval_ms = max(1, min(interval_us, MAX_INTERVAL_US) // 1000) if interval_us > 0 else 0
        if interval_us == 0 and message_id == mav.MAVLINK_MSG_ID_HEARTBEAT:
            interval_ms = HEARTBEAT_INTERVAL_MS
        if message_id not in self._telemetry.names or 0 < interval_ms < SHORTEST_INTERVAL_MS:
            return False
        self._start(message_id, interval_ms)
        return True

    def _due(self) -> list[int]:
        """Return the ids of the messages to send now; after missed slots, each is sent once."""
        now_ns, ready = self._ap.now_ns, []
        for message_id, stream in self._streams.items():
            if now_ns >= stream.due_ns + stream.late_ns:
                period_ns = self._period_ns(stream.interval_us)
                stream.due_ns = next_slot_ns(stream.due_ns, period_ns, now_ns)
                stream.late_ns = self._random_ns(self._conditions.stream_jitter_ms * NS_PER_MS)
                ready.append(message_id)
        return ready

    def _period_ns(self, interval_us: int) -> int:
        return interval_us * NS_PER_US + self._conditions.stream_slowdown_ms * NS_PER_MS

    def _random_ns(self, most_ns: float) -> int:
        return int(self._random.uniform(0.0, most_ns)) if most_ns else 0

    def _start(self, message_id: int, interval_ms: int) -> None:
        self._streams.pop(message_id, None)
        if interval_ms > 0:
            period_ns = self._period_ns(interval_ms * 1000)
            early_ns = self._random_ns(self._conditions.stream_phase_spread * period_ns)
            due_ns = self._ap.now_ns + period_ns - early_ns
            self._streams[message_id] = Stream(interval_us=interval_ms * 1000, due_ns=due_ns)
