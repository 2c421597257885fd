"""Receives MAVLink on all links of a vehicle, without I/O, and acts on it: the part of both
firmwares.

Parameters, time, pings, missions and the dispatch of commands; a firmware adds its own messages and
commands, and decides whom it obeys.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.link.endpoint import Ap, Endpoint, Message
from sitl.report import FlightLog

ACCEPTED: int = mav.MAV_RESULT_ACCEPTED
REJECTED: int = mav.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mav.MAV_RESULT_DENIED
UNSUPPORTED: int = mav.MAV_RESULT_UNSUPPORTED
FAILED: int = mav.MAV_RESULT_FAILED
FORCE = 21196.0  # param 2 of ARM_DISARM that overrules a refusal (MAVLink common.xml)
UINT16_MAX = 65535
MAX_RC_FIELDS = 18
COMMAND_FIELDS = {
    "COMMAND_LONG": tuple(f"param{n}" for n in range(1, 8)),
    "COMMAND_INT": ("param1", "param2", "param3", "param4", "x", "y", "z"),
}

Link = TypeVar("Link", bound=Endpoint[Any])
Params7: TypeAlias = tuple[float, ...]
"""param1..7 of a command, the first at index 0; an unused one may be NaN."""


class MavlinkServer(ABC, Generic[Ap, Link]):
    """Receives on all links of one vehicle, and acts on it."""

    bad_interval: ClassVar[int]
    """MAV_RESULT of a request for the interval of a message whose number is none."""

    def __init__(self, ap: Ap, links: Sequence[Link], log: FlightLog) -> None:
        self.links = tuple(links)
        self.reboot_requested = False
        """A command has requested a reboot."""
        self._ap = ap
        self._log = log
        self._handlers: dict[str, Callable[[Link, Message, int], None]] = {
            "COMMAND_LONG": self._command,
            "COMMAND_INT": self._command,
            "PARAM_REQUEST_LIST": lambda link, _message, _arrived_ns: link.send_all_params(),
            "PARAM_REQUEST_READ": self._param_read,
            "PARAM_SET": self._param_set,
            "MISSION_REQUEST_LIST": self._mission_list,
            "TIMESYNC": self._timesync,
            "PING": self._ping,
        }
        """By message: the link, the message, its arrival."""
        self._commands: dict[int, Callable[[Params7, Link], int | None]] = {
            mav.MAV_CMD_GET_MESSAGE_INTERVAL: self._get_interval,
        }
        """By number: MAV_RESULT for the ack, None for no ack."""

    def restart(self, ap: Ap) -> None:
        """Serve a vehicle that has just booted."""
        self._ap = ap
        self.reboot_requested = False
        for link in self.links:
            link.restart(ap)

    def receive(self, link_id: int, data: bytes, arrived_ns: int) -> None:
        """Act on the bytes of one datagram, or of one read of a stream."""
        link = self.links[link_id]
        for message in link.parse(data):
            self._pass_on(link, message)
            handler = self._handlers.get(message.get_type())
            if handler is not None and self._is_accepted(message):
                handler(link, message, arrived_ns)

    def step(self, now_ns: int) -> None:
        """Queue on every link what is due and what the vehicle has to say; ``now_ns`` is at most
        one control step ahead of it."""
        self._announce()
        for text in self._ap.texts:
            self._log.on_text(self._ap.now_ns, text.text)
            for link in self.links:
                link.send_text(text.severity, text.text)
        self._ap.texts.clear()
        for link in self.links:
            link.step(now_ns)

    @abstractmethod
    def _is_accepted(self, message: Message) -> bool:
        """True if the firmware acts on the message of this sender."""

    @abstractmethod
    def _pass_on(self, link: Link, message: Message) -> None:
        """Take note of a message that came on the link, whoever it is for."""

    @abstractmethod
    def _announce(self) -> None:
        """Queue what goes out before the texts."""

    def _execute(self, message: Message, params: Params7, link: Link) -> int | None:
        """Execute a command; returns the MAV_RESULT for its ack, or None for no ack."""
        handler = self._commands.get(message.command)
        return UNSUPPORTED if handler is None else handler(params, link)

    def _command(self, link: Link, message: Message, _arrived_ns: int) -> None:
        fields = COMMAND_FIELDS[message.get_type()]
        params = tuple(float(getattr(message, name)) for name in fields)
        result = self._execute(message, params, link)
        if result is not None:
            send_ack(link, message, message.command, result)

    def _get_interval(self, params: Params7, link: Link) -> int:
        if not math.isfinite(params[0]) or not 0 <= params[0] <= UINT16_MAX:
            return self.bad_interval
        link.send_interval(int(params[0]))
        return ACCEPTED

    def _param_read(self, link: Link, message: Message, _arrived_ns: int) -> None:
        index, names = message.param_index, self._ap.params.names
        if index < 0 and message.param_id in names:
            index = names.index(message.param_id)
        if 0 <= index < len(names):
            link.send_param(index)

    def _param_set(self, link: Link, message: Message, _arrived_ns: int) -> None:
        if self._ap.params.set_on_wire(message.param_id, message.param_value):
            link.send_param(self._ap.params.names.index(message.param_id))

    def _mission_list(self, link: Link, message: Message, _arrived_ns: int) -> None:
        link.send(mav.MAVLink_mission_count_message(*sender_of(message), 0, message.mission_type))

    def _timesync(self, link: Link, message: Message, arrived_ns: int) -> None:
        """Answer a request; answers (tc1 set) to our own requests need no action."""
        if message.tc1 == 0:
            uptime_us = (arrived_ns - self._ap.boot_ns) // 1000
            link.send(mav.MAVLink_timesync_message(uptime_us * 1000, message.ts1))

    def _ping(self, link: Link, message: Message, _arrived_ns: int) -> None:
        if message.target_system == 0 and message.target_component == 0:
            sender = sender_of(message)
            link.send(mav.MAVLink_ping_message(message.time_usec, message.seq, *sender))


def sender_of(message: Message) -> tuple[int, int]:
    """System and component that a message came from."""
    return message.get_srcSystem(), message.get_srcComponent()


def send_ack(link: Endpoint[Any], message: Message, number: int, result: int) -> None:
    """Answer a command with its MAV_RESULT."""
    link.send(mav.MAVLink_command_ack_message(number, result, 0, 0, *sender_of(message)))
