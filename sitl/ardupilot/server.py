"""Message handling of the simulated ArduPilot, without I/O.

Filters are ArduCopter's as measured: overrides only from MAV_GCS_SYSID (or up to MAV_GCS_SYSID_HI),
commands from any sender, and only messages for target system 0 or the vehicle. Setpoints are never
answered, and ignored outside GUIDED and GUIDED_NOGPS. An invalid one makes GUIDED brake and leaves
GUIDED_NOGPS with its last setpoint, as measured on the firmware.
"""

import math

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.endpoint import ArduPilotEndpoint
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.rc import IGNORE, OVERRIDDEN_CHANNELS, RELEASE
from sitl.link.server import (
    ACCEPTED,
    DENIED,
    FAILED,
    FORCE,
    UNSUPPORTED,
    MavlinkServer,
    Params7,
)
from sitl.link.telemetry import Message
from sitl.report import FlightLog
from sitl.vehicle.firmware import AttitudeSetpoint, VelocitySetpoint
from sitl.vehicle.rotation import from_euler, norm, normalised, rotate

FORCE_REBOOT = 20190226.0  # param 6 of PREFLIGHT_REBOOT_SHUTDOWN: even while armed (ArduPilot)
_OPTION_GCS_ONLY = 1
MAX_NORM_ERROR = 1e-3  # tolerance for the squared length of a quaternion

_RATES_IGNORED = 0b111  # bits of ATTITUDE_TARGET_TYPEMASK
_POSITION_IGNORED, _VELOCITY_IGNORED = 0b111, 0b111 << 3  # bits of POSITION_TARGET_TYPEMASK
_NED_AXES = (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_LOCAL_OFFSET_NED)
_BODY_AXES = (mav.MAV_FRAME_BODY_NED, mav.MAV_FRAME_BODY_OFFSET_NED)


class ArduPilotServer(MavlinkServer[ArduCopter, ArduPilotEndpoint]):
    """ArduPilot's messages and commands."""

    bad_interval, unknown_message = DENIED, FAILED

    def __init__(self, ap: ArduCopter, link_count: int, log: FlightLog) -> None:
        super().__init__(ap, [ArduPilotEndpoint(ap) for _ in range(link_count)], log)
        self._mode = ap.mode

    def _announce(self) -> None:
        """Send a heartbeat at once after a mode change."""
        if self._ap.mode is not self._mode:
            self._mode = self._ap.mode
            for link in self.links:
                link.send_now(mav.MAVLINK_MSG_ID_HEARTBEAT)

    def _is_accepted(self, message: Message) -> bool:
        own = self._ap.system_id
        gcs_only = self._ap.params.integer("MAV_OPTIONS") & _OPTION_GCS_ONLY
        if gcs_only and message.get_srcSystem() != own and not self._is_from_gcs(message):
            return False
        if getattr(message, "target_system", 0) not in (0, own):
            return False
        # Commands mark unused parameters with NaN; each handler checks those that it reads.
        values = [getattr(message, name) for name in message.fieldnames]
        numbers = [value for value in values if isinstance(value, float)]
        if message.get_type() != "COMMAND_LONG" and not all(map(math.isfinite, numbers)):
            self._log.refused_messages += 1
            return False
        return True

    def _is_from_gcs(self, message: Message) -> bool:
        low = self._ap.params.integer("MAV_GCS_SYSID")
        high = max(low, int(self._ap.params.get("MAV_GCS_SYSID_HI", 0.0)))
        return low <= int(message.get_srcSystem()) <= high

    def on_rc_channels_override(self, _link: ArduPilotEndpoint, message: Message) -> None:
        if not self._is_from_gcs(message):
            return
        raw_us = [getattr(message, f"chan{n + 1}_raw") for n in range(OVERRIDDEN_CHANNELS)]
        if set(raw_us) - {RELEASE, IGNORE}:
            self._log.overrides += 1
        elif RELEASE in raw_us:
            self._log.releases += 1
        self._ap.rc.override(raw_us, self._arrived_ns)

    def on_manual_control(self, _link: ArduPilotEndpoint, message: Message) -> None:
        if message.target != self._ap.system_id or not self._is_from_gcs(message):
            return
        self._log.manual_controls += 1
        sticks = {name: getattr(message, name) for name in "xyzr"}
        self._ap.rc.manual_control(**sticks, now_ns=self._arrived_ns)

    def on_set_attitude_target(self, _link: ArduPilotEndpoint, message: Message) -> None:
        ap = self._ap
        if ap.guided is None:
            return
        setpoint = _attitude_setpoint(message)
        if setpoint is not None:
            ap.guided.follow_attitude(setpoint, ap.sensed, self._arrived_ns)
            self._log.setpoints += 1
        elif ap.mode is Mode.GUIDED:
            ap.guided.brake(ap.sensed)

    def on_set_position_target_local_ned(self, _link: ArduPilotEndpoint, message: Message) -> None:
        """Follow a velocity in GUIDED; GUIDED_NOGPS ignores it."""
        ap = self._ap
        if ap.guided is None or ap.mode is not Mode.GUIDED:
            return
        setpoint = _velocity_setpoint(message, ap.yaw_rad)
        if setpoint is None:
            ap.guided.brake(ap.sensed)
        else:
            ap.guided.follow_velocity(setpoint, ap.sensed, self._arrived_ns)
            self._log.setpoints += 1

    def cmd_do_set_mode(self, params: Params7, _link: ArduPilotEndpoint) -> int:
        is_finite = all(map(math.isfinite, params[:2]))
        if not is_finite or not int(params[0]) & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            return DENIED
        try:
            mode = Mode(int(params[1]))
        except ValueError:
            return FAILED
        return self._to_mode(mode)

    def cmd_nav_return_to_launch(self, _params: Params7, _link: ArduPilotEndpoint) -> int:
        return self._to_mode(Mode.RTL)

    def cmd_nav_land(self, _params: Params7, _link: ArduPilotEndpoint) -> int:
        return self._to_mode(Mode.LAND)

    def _to_mode(self, mode: Mode) -> int:
        return ACCEPTED if self._ap.set_mode(mode) else FAILED

    def cmd_component_arm_disarm(self, params: Params7, _link: ArduPilotEndpoint) -> int:
        if params[0] not in (0.0, 1.0):
            return UNSUPPORTED
        force = params[1] == FORCE
        done = self._ap.arm(force=force) if params[0] else self._ap.disarm(force=force)
        return ACCEPTED if done else FAILED

    def cmd_nav_takeoff(self, params: Params7, _link: ArduPilotEndpoint) -> int:
        height_m = params[6]
        return ACCEPTED if math.isfinite(height_m) and self._ap.take_off(height_m) else FAILED

    def cmd_preflight_reboot_shutdown(self, params: Params7, _link: ArduPilotEndpoint) -> int:
        if self._ap.armed and params[5] != FORCE_REBOOT:
            return FAILED
        if params[0] not in (1.0, 3.0):
            return UNSUPPORTED
        self.reboot_requested = True
        return ACCEPTED


def _attitude_setpoint(message: Message) -> AttitudeSetpoint | None:
    mask = message.type_mask
    ignored_rates = mask & _RATES_IGNORED
    has_thrust = not mask & mav.ATTITUDE_TARGET_TYPEMASK_THROTTLE_IGNORE
    if not has_thrust or ignored_rates not in (0, _RATES_IGNORED):
        return None
    attitude = None
    if not mask & mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE:
        if not abs(norm(message.q) ** 2 - 1.0) <= MAX_NORM_ERROR:  # negated, to refuse NaN
            return None
        attitude = normalised(message.q)
    rate = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
    return AttitudeSetpoint(attitude, (0.0, 0.0, 0.0) if ignored_rates else rate, message.thrust)


def _velocity_setpoint(message: Message, heading_rad: float) -> VelocitySetpoint | None:
    """Return the velocity in NED axes; ignore accelerations and a heading in the message."""
    mask = message.type_mask
    if mask & _VELOCITY_IGNORED or mask & _POSITION_IGNORED != _POSITION_IGNORED:
        return None
    velocity_mps = (message.vx, message.vy, message.vz)
    if message.coordinate_frame in _BODY_AXES:
        velocity_mps = rotate(from_euler(0.0, 0.0, heading_rad), velocity_mps)
    elif message.coordinate_frame not in _NED_AXES:
        return None
    has_rate = not mask & mav.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
    return VelocitySetpoint(velocity_mps, message.yaw_rate if has_rate else 0.0)
