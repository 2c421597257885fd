"""Receives MAVLink on all links of a PX4 vehicle, without I/O, and forwards between them.

Nobody is filtered: sticks, setpoints and commands of any system are taken if they are addressed to
the vehicle or to everybody.
"""

import math

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.link.framing import Message
from sitl.px4.autopilot import Autopilot
from sitl.px4.link.commands import change_mode, execute
from sitl.px4.link.endpoint import MavlinkEndpoint
from sitl.px4.setpoints import AttitudeSetpoint, RateSetpoint, Setpoint, VelocitySetpoint
from sitl.px4.sticks import from_manual_control
from sitl.report import FlightLog
from sitl.rotation import Vec3, to_euler

RC_CHANNELS = 18
_RC_IGNORE = 65535
_COMMAND_FIELDS = {
    "COMMAND_LONG": tuple(f"param{n}" for n in range(1, 8)),
    "COMMAND_INT": ("param1", "param2", "param3", "param4", "x", "y", "z"),
}
_IGNORE_ATTITUDE = mav.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
_IGNORE_RATES = 0b111
_IGNORE_YAW_RATE = 0b100
_IGNORE_POSITION, _IGNORE_VELOCITY = 0b111, 0b111 << 3
_IGNORE_YAW, _IGNORE_YAW_SPEED = 1 << 10, 1 << 11


class MavlinkServer:
    """Receives on all links of one vehicle, and acts on it."""

    def __init__(self, ap: Autopilot, link_count: int, log: FlightLog) -> None:
        onboard = ap.config.onboard_links
        self.links = tuple(MavlinkEndpoint(ap, is_onboard=n in onboard) for n in range(link_count))
        self.reboot_requested = False  # PX4 denies it in simulation
        self._ap = ap
        self._log = log
        self._handlers = {
            "HEARTBEAT": self._heartbeat,
            "MANUAL_CONTROL": self._manual_control,
            "RC_CHANNELS_OVERRIDE": self._override,
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "SET_MODE": self._set_mode,
            "SET_ATTITUDE_TARGET": self._set_attitude_target,
            "SET_POSITION_TARGET_LOCAL_NED": self._set_position_target,
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "MISSION_REQUEST_LIST": self._mission_list,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
        }

    def restart(self, ap: Autopilot) -> None:
        """Serve a vehicle that has just booted."""
        self._ap = ap
        for link in self.links:
            link.restart(ap)

    def receive(self, link_id: int, data: bytes, arrived_ns: int) -> None:
        """Act on the bytes of one datagram, or of one read of a stream."""
        link = self.links[link_id]
        for message in link.parse(data):
            link.heard.add((message.get_srcSystem(), message.get_srcComponent()))
            self._forward(link, message)
            handler = self._handlers.get(message.get_type())
            if handler is not None and self._is_for_us(message):
                handler(link_id, message, arrived_ns)

    def step(self, now_ns: int) -> None:
        """Queue what is due on every link, and what the vehicle has to say."""
        commander = self._ap.commander
        for event in commander.events:
            for link in self.links:
                link.send_event(event)
        for text in commander.texts:
            self._log.on_text(self._ap.now_ns, text.text)
            for link in self.links:
                link.send_text(text.severity, text.text)
        commander.events.clear()
        commander.texts.clear()
        for link in self.links:
            link.step(now_ns)

    def _own_system(self) -> int:
        return self._ap.params.integer("MAV_SYS_ID")

    def _is_for_us(self, message: Message) -> bool:
        system = getattr(message, "target_system", getattr(message, "target", 0))
        component = getattr(message, "target_component", 0)
        is_ours = component in (0, mav.MAV_COMP_ID_AUTOPILOT1)
        return system in (0, self._own_system()) and is_ours

    def _forward(self, origin: MavlinkEndpoint, message: Message) -> None:
        """Pass a frame on to the other links, as it is.

        What is addressed to everybody goes everywhere; MANUAL_CONTROL counts as such, since its
        target is no ordinary target field. The rest goes where its addressee was heard.
        """
        system = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        if (system, component) == (self._own_system(), mav.MAV_COMP_ID_AUTOPILOT1):
            return
        is_heartbeat = message.get_type() == "HEARTBEAT"
        if is_heartbeat and message.type != mav.MAV_TYPE_GCS:
            return
        for link in self.links:
            if link is origin:
                continue
            heard = any(
                system in (0, known_system) and component in (0, known_component)
                for known_system, known_component in link.heard
            )
            if system == 0 or heard:
                link.pass_on(bytes(message.get_msgbuf()))

    def _heartbeat(self, link_id: int, message: Message, _arrived_ns: int) -> None:
        if message.type == mav.MAV_TYPE_GCS:
            self.links[link_id].has_gcs = True

    def _manual_control(self, link_id: int, message: Message, arrived_ns: int) -> None:
        self._log.on_manual_control(arrived_ns)
        sticks = from_manual_control(message.x, message.y, message.z, message.r)
        self._ap.stick_input.on_sticks(link_id, sticks, arrived_ns)

    def _override(self, _link_id: int, message: Message, arrived_ns: int) -> None:
        """No override: the values become those of a receiver."""
        self._log.on_override(arrived_ns)
        values = [getattr(message, f"chan{n}_raw") for n in range(1, RC_CHANNELS + 1)]
        self._ap.set_receiver([0 if value == _RC_IGNORE else value for value in values])

    def _command(self, link_id: int, message: Message, _arrived_ns: int) -> None:
        link = self.links[link_id]
        fields = _COMMAND_FIELDS[message.get_type()]
        params = tuple(float(getattr(message, name)) for name in fields)
        result: int | None
        if message.command == mav.MAV_CMD_DO_SET_MODE:
            base_mode, main, sub = params[:3]
            says_why = _is_ground_station(message)
            result = change_mode(base_mode, main, sub, self._ap, says_why=says_why)
        else:
            result = execute(message.command, params, self._ap, link)
        if result is not None:
            link.send(_ack(message, message.command, result))

    def _set_mode(self, link_id: int, message: Message, _arrived_ns: int) -> None:
        """The old message: acknowledged as the command that replaced it."""
        main, sub = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
        says_why = _is_ground_station(message)
        result = change_mode(message.base_mode, main, sub, self._ap, says_why=says_why)
        self.links[link_id].send(_ack(message, mav.MAV_CMD_DO_SET_MODE, result))

    def _set_attitude_target(self, _link_id: int, message: Message, arrived_ns: int) -> None:
        mask = message.type_mask
        rates: Vec3 = (message.body_roll_rate, message.body_pitch_rate, message.body_yaw_rate)
        if not mask & _IGNORE_ATTITUDE:
            yaw_rate = 0.0 if mask & _IGNORE_YAW_RATE else message.body_yaw_rate
            w, x, y, z = message.q
            length = math.sqrt(w * w + x * x + y * y + z * z)
            if not (math.isfinite(length) and length > 0.5 and math.isfinite(yaw_rate)):
                self._log.refused_messages += 1
                return
            attitude = (w / length, x / length, y / length, z / length)
            setpoint = AttitudeSetpoint(attitude, yaw_rate, _thrust(message))
            self._follow(setpoint, arrived_ns)
        elif not mask & _IGNORE_RATES and all(map(math.isfinite, rates)):
            self._follow(RateSetpoint(rates, _thrust(message)), arrived_ns)

    def _set_position_target(self, link_id: int, message: Message, arrived_ns: int) -> None:
        frame, mask = message.coordinate_frame, message.type_mask
        if frame not in (mav.MAV_FRAME_LOCAL_NED, mav.MAV_FRAME_BODY_NED):
            self._ap.commander.refuse_frame(frame)
            return
        velocity: Vec3 | None = (message.vx, message.vy, message.vz)
        position: Vec3 | None = (message.x, message.y, message.z)
        is_body = frame == mav.MAV_FRAME_BODY_NED
        if mask & _IGNORE_VELOCITY or velocity is None:
            velocity = None
        elif is_body:
            velocity = self._from_heading(velocity)
        if mask & _IGNORE_POSITION or is_body:
            position = None
        if velocity is None and position is None:
            return
        yaw = None if mask & _IGNORE_YAW else message.yaw
        yaw_rate = 0.0 if mask & _IGNORE_YAW_SPEED else message.yaw_rate
        numbers = (*(velocity or ()), *(position or ()), yaw_rate, 0.0 if yaw is None else yaw)
        if not all(map(math.isfinite, numbers)):
            self._log.refused_messages += 1
            return
        self._follow(VelocitySetpoint(position, velocity, yaw, yaw_rate), arrived_ns)

    def _follow(self, setpoint: Setpoint, arrived_ns: int) -> None:
        self._ap.set_setpoint(setpoint, arrived_ns)
        if self._ap.mode_name == "OFFBOARD":
            self._log.on_setpoint(arrived_ns)

    def _from_heading(self, velocity: Vec3) -> Vec3:
        """A velocity forward, right and down, in NED."""
        yaw = to_euler(self._ap.sensed.ned_from_body_wxyz)[2]
        forward, right, down = velocity
        cy, sy = math.cos(yaw), math.sin(yaw)
        return (forward * cy - right * sy, forward * sy + right * cy, down)

    def _param_list(self, link_id: int, _message: Message, _arrived_ns: int) -> None:
        self.links[link_id].send_all_params()

    def _param_read(self, link_id: int, message: Message, _arrived_ns: int) -> None:
        index, names = message.param_index, self._ap.params.names
        if index < 0 and message.param_id in names:
            index = names.index(message.param_id)
        if 0 <= index < len(names):
            self.links[link_id].send_param(index)

    def _param_set(self, link_id: int, message: Message, _arrived_ns: int) -> None:
        if self._ap.params.set_from_wire(message.param_id, message.param_value):
            self.links[link_id].send_param(self._ap.params.names.index(message.param_id))

    def _mission_list(self, link_id: int, message: Message, _arrived_ns: int) -> None:
        count = mav.MAVLink_mission_count_message(*_sender(message), 0, message.mission_type)
        self.links[link_id].send(count)

    def _timesync(self, link_id: int, message: Message, arrived_ns: int) -> None:
        """Answer a request; answers (tc1 set) to our own requests need no action."""
        if message.tc1 == 0:
            uptime_us = (arrived_ns - self._ap.boot_ns) // 1000
            answer = mav.MAVLink_timesync_message(uptime_us * 1000, message.ts1)
            self.links[link_id].send(answer)

    def _ping(self, link_id: int, message: Message, _arrived_ns: int) -> None:
        if message.target_system == 0 and message.target_component == 0:
            sender = _sender(message)
            answer = mav.MAVLink_ping_message(message.time_usec, message.seq, *sender)
            self.links[link_id].send(answer)


def _sender(message: Message) -> tuple[int, int]:
    return message.get_srcSystem(), message.get_srcComponent()


def _is_ground_station(message: Message) -> bool:
    return bool(message.get_srcComponent() == mav.MAV_COMP_ID_MISSIONPLANNER)


def _ack(message: Message, number: int, result: int) -> Message:
    return mav.MAVLink_command_ack_message(number, result, 0, 0, *_sender(message))


def _thrust(message: Message) -> float:
    return max(0.0, min(1.0, message.thrust)) if math.isfinite(message.thrust) else 0.0
