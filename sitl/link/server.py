"""The vehicle's MAVLink edge, without I/O: who is listened to, and what each message does.

Filters are ArduCopter's as measured: overrides only from MAV_GCS_SYSID (or up to MAV_GCS_SYSID_HI),
commands from anybody, everything only for target system 0 or the vehicle's own.
"""

import math

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.link.commands import Command, execute, mode_by_number
from sitl.link.endpoint import Link
from sitl.link.messages import Message
from sitl.report import FlightLog
from sitl.vehicle.autopilot import Autopilot
from sitl.vehicle.rc import IGNORE, PRIMARY_CHANNELS, RELEASE

MAX_RC_FIELDS = 18
_OPTION_GCS_ONLY = 1


class MavlinkServer:
    """All links of one vehicle."""

    def __init__(self, ap: Autopilot, link_count: int, log: FlightLog) -> None:
        self.links = tuple(Link(ap) for _ in range(link_count))
        self._ap = ap
        self._log = log
        self._handlers = {
            "HEARTBEAT": self._heartbeat,
            "RC_CHANNELS_OVERRIDE": self._override,
            "MANUAL_CONTROL": self._manual_control,
            "COMMAND_LONG": self._command_long,
            "COMMAND_INT": self._command_int,
            "SET_MODE": self._set_mode,
            "REQUEST_DATA_STREAM": self._request_data_stream,
            "PARAM_REQUEST_LIST": self._param_list,
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "MISSION_REQUEST_LIST": self._mission_list,
            "MISSION_COUNT": self._mission_refused,
            "MISSION_CLEAR_ALL": self._mission_refused,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
        }

    @property
    def reboot_requested(self) -> bool:
        """A command has asked for a reboot."""
        return any(link.reboot_requested for link in self.links)

    def restart(self, ap: Autopilot) -> None:
        """Serve a vehicle that has just booted."""
        self._ap = ap
        for link in self.links:
            link.restart(ap)

    def receive(self, link_id: int, data: bytes, arrived_ns: int) -> None:
        """Act on the bytes of one datagram, or of one read of a stream."""
        link = self.links[link_id]
        for message in link.parse(data):
            handler = self._handlers.get(message.get_type())
            if handler is None or not self._is_for_us(message):
                continue
            if not _is_command(message) and _has_nan(message):
                self._log.refused_messages += 1
                continue
            handler(link, message, arrived_ns)

    def step(self) -> None:
        """Queue on every link what is due; texts go to all."""
        for text in self._ap.texts:
            self._log.on_text(self._ap.now_ns, text.text)
            for link in self.links:
                link.say(text.severity, text.text)
        self._ap.texts.clear()
        for link in self.links:
            link.step()

    def _is_for_us(self, message: Message) -> bool:
        own = self._ap.params.integer("MAV_SYSID")
        sender = message.get_srcSystem()
        gcs_only = self._ap.params.integer("MAV_OPTIONS") & _OPTION_GCS_ONLY
        if gcs_only and sender != own and not self._is_gcs(sender):
            return False
        return getattr(message, "target_system", 0) in (0, own)

    def _is_gcs(self, system_id: int) -> bool:
        low = self._ap.params.integer("MAV_GCS_SYSID")
        return low <= system_id <= max(low, self._ap.params.integer("MAV_GCS_SYSID_HI"))

    def _heartbeat(self, link: Link, message: Message, arrived_ns: int) -> None:
        if self._is_gcs(message.get_srcSystem()):
            self._ap.gcs_failsafe.seen(arrived_ns)

    def _override(self, link: Link, message: Message, arrived_ns: int) -> None:
        if not self._is_gcs(message.get_srcSystem()):
            return
        self._ap.gcs_failsafe.seen(arrived_ns)
        raw_us = [getattr(message, f"chan{n}_raw") for n in range(1, MAX_RC_FIELDS + 1)]
        primary = set(raw_us[:PRIMARY_CHANNELS])
        if primary - {RELEASE, IGNORE}:
            self._log.on_override(arrived_ns)
        elif RELEASE in primary:
            self._log.on_release(arrived_ns)
        self._ap.rc.override(raw_us, arrived_ns)

    def _manual_control(self, link: Link, message: Message, arrived_ns: int) -> None:
        if not self._is_gcs(message.get_srcSystem()):
            return
        if message.target != self._ap.params.integer("MAV_SYSID"):
            return
        self._ap.gcs_failsafe.seen(arrived_ns)
        self._log.on_manual_control()
        self._ap.rc.manual_control(
            x=message.x, y=message.y, z=message.z, r=message.r, now_ns=arrived_ns
        )

    def _command_long(self, link: Link, message: Message, arrived_ns: int) -> None:
        params = tuple(getattr(message, f"param{n}") for n in range(1, 8))
        self._execute(link, message, Command(number=message.command, params=params))

    def _command_int(self, link: Link, message: Message, arrived_ns: int) -> None:
        params = (
            message.param1,
            message.param2,
            message.param3,
            message.param4,
            float(message.x),
            float(message.y),
            message.z,
        )
        self._execute(link, message, Command(number=message.command, params=params))

    def _execute(self, link: Link, message: Message, command: Command) -> None:
        self._ack(link, message, command.number, execute(command, self._ap, link))

    def _ack(self, link: Link, message: Message, number: int, result: int) -> None:
        link.send(
            mav.MAVLink_command_ack_message(
                number, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
        )

    def _set_mode(self, link: Link, message: Message, arrived_ns: int) -> None:
        result = mav.MAV_RESULT_DENIED
        if message.base_mode & mav.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED:
            result = mode_by_number(message.custom_mode, self._ap)
        self._ack(link, message, mav.MAVLINK_MSG_ID_SET_MODE, result)

    def _request_data_stream(self, link: Link, message: Message, arrived_ns: int) -> None:
        rate_hz = message.req_message_rate if message.start_stop else 0
        link.set_group(message.req_stream_id, rate_hz)

    def _param_list(self, link: Link, message: Message, arrived_ns: int) -> None:
        link.queue_params()

    def _param_read(self, link: Link, message: Message, arrived_ns: int) -> None:
        index = message.param_index
        if index < 0 and message.param_id in self._ap.params:
            index = self._ap.params.names.index(message.param_id)
        if 0 <= index < len(self._ap.params):
            link.send_param(index)

    def _param_set(self, link: Link, message: Message, arrived_ns: int) -> None:
        if self._ap.params.set(message.param_id, message.param_value):
            link.send_param(self._ap.params.names.index(message.param_id))

    def _mission_list(self, link: Link, message: Message, arrived_ns: int) -> None:
        link.send(
            mav.MAVLink_mission_count_message(
                message.get_srcSystem(), message.get_srcComponent(), 0, message.mission_type
            )
        )

    def _mission_refused(self, link: Link, message: Message, arrived_ns: int) -> None:
        link.send(
            mav.MAVLink_mission_ack_message(
                message.get_srcSystem(),
                message.get_srcComponent(),
                mav.MAV_MISSION_UNSUPPORTED,
                message.mission_type,
            )
        )

    def _timesync(self, link: Link, message: Message, arrived_ns: int) -> None:
        """Answer a request; answers (tc1 set) to our own requests need no action."""
        if message.tc1 == 0:
            uptime_us = (arrived_ns - self._ap.boot_ns) // 1000
            link.send(mav.MAVLink_timesync_message(uptime_us * 1000, message.ts1))

    def _ping(self, link: Link, message: Message, arrived_ns: int) -> None:
        if message.target_system == 0 and message.target_component == 0:
            link.send(
                mav.MAVLink_ping_message(
                    message.time_usec,
                    message.seq,
                    message.get_srcSystem(),
                    message.get_srcComponent(),
                )
            )


def _is_command(message: Message) -> bool:
    """Commands mark unused parameters with NaN; each command checks those that it reads."""
    return message.get_type() in ("COMMAND_LONG", "COMMAND_INT")


def _has_nan(message: Message) -> bool:
    values = (getattr(message, name) for name in message.fieldnames)
    return any(isinstance(value, float) and not math.isfinite(value) for value in values)
