"""Message handling of the simulated PX4, without I/O.

Senders are not filtered: sticks, setpoints and commands of any system are accepted if they are
addressed to the vehicle or broadcast.
"""

import cmath
import math

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.link.server import (
    ACCEPTED,
    DENIED,
    FAILED,
    FORCE,
    REJECTED,
    MavlinkServer,
    Params7,
)
from sitl.link.telemetry import Message
from sitl.px4.autopilot import Px4
from sitl.px4.endpoint import Px4Endpoint, Px4Telemetry
from sitl.px4.flight import Setpoint
from sitl.px4.modes import Px4Mode, mode_of
from sitl.px4.sticks import from_manual_control
from sitl.report import FlightLog
from sitl.vehicle.firmware import AttitudeSetpoint, VelocitySetpoint
from sitl.vehicle.rotation import Vec3, horizontal, norm, normalised

_IGNORE_ATTITUDE = mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
_IGNORE_RATES = 0b111
_IGNORE_YAW_RATE = 0b100
_IGNORE_VELOCITY, _IGNORE_YAW_SPEED = 0b111 << 3, 1 << 11


class Px4Server(MavlinkServer[Px4, Px4Endpoint]):
    """PX4's messages and commands; in simulation PX4 denies a reboot."""

    bad_interval, unknown_message = FAILED, DENIED

    def __init__(self, ap: Px4, link_count: int, log: FlightLog) -> None:
        super().__init__(ap, [Px4Endpoint(ap) for _ in range(link_count)], log)

    def _announce(self) -> None:
        """Send events before the texts."""
        events = self._ap.events
        for event in events:
            for link in self.links:
                link.send_event(event)
        events.clear()

    def _is_accepted(self, message: Message) -> bool:
        system = getattr(message, "target_system", getattr(message, "target", 0))
        component = getattr(message, "target_component", 0)
        is_ours = component in (0, mav.MAV_COMP_ID_AUTOPILOT1)
        return system in (0, self._ap.system_id) and is_ours

    def on_heartbeat(self, link: Px4Endpoint, message: Message) -> None:
        if message.type == mav.MAV_TYPE_GCS:
            link.has_gcs = True

    def on_manual_control(self, link: Px4Endpoint, message: Message) -> None:
        self._log.manual_controls += 1
        sticks = from_manual_control(message.x, message.y, message.z, message.r)
        self._ap.stick_input.on_sticks(self.links.index(link), sticks, self._arrived_ns)

    def on_set_attitude_target(self, _link: Px4Endpoint, message: Message) -> None:
        mask = message.type_mask
        rates: Vec3 = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
        if not mask & _IGNORE_ATTITUDE:
            yaw_rate = 0.0 if mask & _IGNORE_YAW_RATE else message.body_yaw_rate
            if not (0.5 < norm(message.q) < math.inf and math.isfinite(yaw_rate)):
                self._log.refused_messages += 1
                return
            turn = (0.0, 0.0, yaw_rate)
            setpoint = AttitudeSetpoint(normalised(message.q), turn, _thrust(message))
            self._follow(setpoint)
        elif not mask & _IGNORE_RATES and all(map(math.isfinite, rates)):
            self._follow(AttitudeSetpoint(None, rates, _thrust(message)))

    def on_set_position_target_local_ned(self, link: Px4Endpoint, message: Message) -> None:
        frame, mask = message.coordinate_frame, message.type_mask
        is_known = frame in (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_NED)
        if not is_known or mask & _IGNORE_VELOCITY:
            return
        velocity: Vec3 = (message.vx, message.vy, message.vz)
        if frame == mav.MAV_FRAME_BODY_NED:
            level = horizontal(velocity) * cmath.rect(1.0, self._ap.yaw_rad)
            velocity = (level.real, level.imag, message.vz)
        yaw_rate = 0.0 if mask & _IGNORE_YAW_SPEED else message.yaw_rate
        if not all(map(math.isfinite, (*velocity, yaw_rate))):
            self._log.refused_messages += 1
            return
        self._follow(VelocitySetpoint(velocity, yaw_rate))

    def _follow(self, setpoint: Setpoint) -> None:
        self._ap.set_setpoint(setpoint, self._arrived_ns)
        if self._ap.mode_name == "OFFBOARD":
            self._log.setpoints += 1

    def cmd_do_set_mode(self, params: Params7, _link: Px4Endpoint) -> int:
        base_mode, main, sub = params[:3]
        if not all(map(math.isfinite, params[:3])):
            return REJECTED
        mode = mode_of(int(main), int(sub))
        if not int(base_mode) & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED or mode is None:
            return REJECTED
        if mode is Px4Mode.AUTO_TAKEOFF:
            self._ap.prepare_takeoff(None)
        return self._to_mode(mode)

    def cmd_nav_return_to_launch(self, _params: Params7, _link: Px4Endpoint) -> int:
        return self._to_mode(Px4Mode.AUTO_RTL)

    def cmd_nav_land(self, _params: Params7, _link: Px4Endpoint) -> int:
        return self._to_mode(Px4Mode.AUTO_LAND)

    def _to_mode(self, mode: Px4Mode) -> int:
        return ACCEPTED if self._ap.set_mode(mode) else REJECTED

    def cmd_component_arm_disarm(self, params: Params7, _link: Px4Endpoint) -> int:
        is_forced = params[1] == FORCE
        done = self._ap.arm() if params[0] == 1.0 else self._ap.disarm(force=is_forced)
        return ACCEPTED if done else REJECTED

    def cmd_nav_takeoff(self, params: Params7, _link: Px4Endpoint) -> int:
        """Take off to param 7, an altitude above sea level; NaN: climb by MIS_TAKEOFF_ALT."""
        height_m = params[6] - Px4Telemetry.alt_m
        self._ap.prepare_takeoff(height_m if math.isfinite(height_m) else None)
        return self._to_mode(Px4Mode.AUTO_TAKEOFF)

    def cmd_preflight_reboot_shutdown(self, params: Params7, _link: Px4Endpoint) -> int:
        """Accept 0, a no-op. PX4 refuses a reboot while armed, and always in SITL."""
        return ACCEPTED if math.isfinite(params[0]) and int(params[0]) == 0 else DENIED


def _thrust(message: Message) -> float:
    return max(0.0, min(1.0, message.thrust)) if math.isfinite(message.thrust) else 0.0
