"""Receives MAVLink on all links of the vehicle, without I/O: who is obeyed, what a message does.

Filters are ArduCopter's as measured: overrides only from MAV_GCS_SYSID (or up to MAV_GCS_SYSID_HI),
commands from anybody, everything only for target system 0 or the vehicle's own.
"""

import math

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.autopilot import Autopilot
from sitl.ardupilot.link.commands import DENIED, execute, mode_by_number
from sitl.ardupilot.link.endpoint import MavlinkEndpoint
from sitl.ardupilot.rc import IGNORE, PRIMARY_CHANNELS, RELEASE
from sitl.ardupilot.setpoints import set_attitude_target, set_position_target
from sitl.link.framing import Message
from sitl.report import FlightLog

MAX_RC_FIELDS = 18
_OPTION_GCS_ONLY = 1
_COMMAND_FIELDS = {
    "COMMAND_LONG": tuple(f"param{n}" for n in range(1, 8)),
    "COMMAND_INT": ("param1", "param2", "param3", "param4", "x", "y", "z"),
}


class MavlinkServer:
    """Receives on all links of one vehicle, and acts on it."""

    def __init__(self, ap: Autopilot, link_count: int, log: FlightLog) -> None:
        self.links = tuple(MavlinkEndpoint(ap) for _ in range(link_count))
        self._ap = ap
        self._mode = ap.mode
        self._log = log
        self._handlers = {
            "HEARTBEAT": self._heartbeat,
            "RC_CHANNELS_OVERRIDE": self._override,
            "MANUAL_CONTROL": self._manual_control,
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "SET_MODE": self._set_mode,
            "SET_ATTITUDE_TARGET": self._attitude_target,
            "SET_POSITION_TARGET_LOCAL_NED": self._position_target,
            "REQUEST_DATA_STREAM": self._data_stream,
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "MISSION_REQUEST_LIST": self._mission_list,
            "MISSION_COUNT": self._refuse_mission,
            "MISSION_CLEAR_ALL": self._refuse_mission,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
        }

    @property
    def reboot_requested(self) -> bool:
        """A command has requested a reboot."""
        return any(link.reboot_requested for link in self.links)

    def restart(self, ap: Autopilot) -> None:
        """Serve a vehicle that has just booted."""
        self._ap = ap
        self._mode = ap.mode
        for link in self.links:
            link.restart(ap)

    def receive(self, link_id: int, data: bytes, arrived_ns: int) -> None:
        """Act on the bytes of one datagram, or of one read of a stream."""
        link = self.links[link_id]
        for message in link.parse(data):
            handler = self._handlers.get(message.get_type())
            if handler is None or not self._is_accepted(message):
                continue
            # Commands mark unused parameters with NaN; each checks those that it reads.
            values = [getattr(message, name) for name in message.fieldnames]
            numbers = [value for value in values if isinstance(value, float)]
            if handler != self._command and not all(map(math.isfinite, numbers)):
                self._log.refused_messages += 1
                continue
            handler(link, message, arrived_ns)

    def step(self, _now_ns: int) -> None:
        """Queue what is due on every link; texts go to all, and at a change of mode a heartbeat."""
        if self._ap.mode is not self._mode:
            self._mode = self._ap.mode
            for link in self.links:
                link.send_now(mav.MAVLINK_MSG_ID_HEARTBEAT)
        for text in self._ap.texts:
            self._log.on_text(self._ap.now_ns, text.text)
            for link in self.links:
                link.send_text(text.severity, text.text)
        self._ap.texts.clear()
        for link in self.links:
            link.step()

    def _is_accepted(self, message: Message) -> bool:
        own = self._ap.params.integer("MAV_SYSID")
        gcs_only = self._ap.params.integer("MAV_OPTIONS") & _OPTION_GCS_ONLY
        if gcs_only and message.get_srcSystem() != own and not self._is_from_gcs(message):
            return False
        return getattr(message, "target_system", 0) in (0, own)

    def _is_from_gcs(self, message: Message) -> bool:
        low = self._ap.params.integer("MAV_GCS_SYSID")
        high = max(low, self._ap.params.integer("MAV_GCS_SYSID_HI"))
        return low <= int(message.get_srcSystem()) <= high

    def _heartbeat(self, _link: MavlinkEndpoint, message: Message, arrived_ns: int) -> None:
        if self._is_from_gcs(message):
            self._ap.gcs_failsafe.on_contact(arrived_ns)

    def _override(self, _link: MavlinkEndpoint, message: Message, arrived_ns: int) -> None:
        if not self._is_from_gcs(message):
            return
        self._ap.gcs_failsafe.on_contact(arrived_ns)
        raw_us = [getattr(message, f"chan{n}_raw") for n in range(1, MAX_RC_FIELDS + 1)]
        primary = set(raw_us[:PRIMARY_CHANNELS])
        if primary - {RELEASE, IGNORE}:
            self._log.on_override(arrived_ns)
        elif RELEASE in primary:
            self._log.on_release(arrived_ns)
        self._ap.rc.override(raw_us, arrived_ns)

    def _manual_control(self, _link: MavlinkEndpoint, message: Message, arrived_ns: int) -> None:
        is_for_us = message.target == self._ap.params.integer("MAV_SYSID")
        if not is_for_us or not self._is_from_gcs(message):
            return
        self._ap.gcs_failsafe.on_contact(arrived_ns)
        self._log.on_manual_control(arrived_ns)
        self._ap.rc.manual_control(
            x=message.x, y=message.y, z=message.z, r=message.r, now_ns=arrived_ns
        )

    def _attitude_target(self, _link: MavlinkEndpoint, message: Message, arrived_ns: int) -> None:
        if set_attitude_target(message, self._ap, arrived_ns):
            self._log.on_setpoint(arrived_ns)

    def _position_target(self, _link: MavlinkEndpoint, message: Message, arrived_ns: int) -> None:
        if set_position_target(message, self._ap, arrived_ns):
            self._log.on_setpoint(arrived_ns)

    def _command(self, link: MavlinkEndpoint, message: Message, _arrived_ns: int) -> None:
        fields = _COMMAND_FIELDS[message.get_type()]
        params = tuple(float(getattr(message, name)) for name in fields)
        result = execute(message.command, params, self._ap, link)
        _send_ack(link, message, message.command, result)

    def _set_mode(self, link: MavlinkEndpoint, message: Message, _arrived_ns: int) -> None:
        has_mode = message.base_mode & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        result = mode_by_number(message.custom_mode, self._ap) if has_mode else DENIED
        _send_ack(link, message, mav.MAVLINK_MSG_ID_SET_MODE, result)

    def _data_stream(self, link: MavlinkEndpoint, message: Message, _arrived_ns: int) -> None:
        rate_hz = message.req_message_rate if message.start_stop else 0
        link.set_group(message.req_stream_id, rate_hz)

    def _param_list(self, link: MavlinkEndpoint, _message: Message, _arrived_ns: int) -> None:
        link.send_all_params()

    def _param_read(self, link: MavlinkEndpoint, message: Message, _arrived_ns: int) -> None:
        index, names = message.param_index, self._ap.params.names
        if index < 0 and message.param_id in names:
            index = names.index(message.param_id)
        if 0 <= index < len(names):
            link.send_param(index)

    def _param_set(self, link: MavlinkEndpoint, message: Message, _arrived_ns: int) -> None:
        if self._ap.params.set_on_wire(message.param_id, message.param_value):
            link.send_param(self._ap.params.names.index(message.param_id))

    def _mission_list(self, link: MavlinkEndpoint, message: Message, _arrived_ns: int) -> None:
        sender = _sender(message)
        link.send(mav.MAVLink_mission_count_message(*sender, 0, message.mission_type))

    def _refuse_mission(self, link: MavlinkEndpoint, message: Message, _arrived_ns: int) -> None:
        result = mav.MAV_MISSION_UNSUPPORTED
        link.send(mav.MAVLink_mission_ack_message(*_sender(message), result, message.mission_type))

    def _timesync(self, link: MavlinkEndpoint, message: Message, arrived_ns: int) -> None:
        """Answer a request; answers (tc1 set) to our own requests need no action."""
        if message.tc1 == 0:
            uptime_us = (arrived_ns - self._ap.boot_ns) // 1000
            link.send(mav.MAVLink_timesync_message(uptime_us * 1000, message.ts1))

    def _ping(self, link: MavlinkEndpoint, message: Message, _arrived_ns: int) -> None:
        if message.target_system == 0 and message.target_component == 0:
            sender = _sender(message)
            link.send(mav.MAVLink_ping_message(message.time_usec, message.seq, *sender))


def _sender(message: Message) -> tuple[int, int]:
    return message.get_srcSystem(), message.get_srcComponent()


def _send_ack(link: MavlinkEndpoint, message: Message, number: int, result: int) -> None:
    link.send(mav.MAVLink_command_ack_message(number, result, 0, 0, *_sender(message)))
