"""Message handling of a vehicle's links, without I/O: the part that both firmwares share.

Parameters, time and the dispatch of commands. A firmware adds its messages and
commands, and decides which senders it obeys.
"""

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeAlias, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_MS
from sitl.link.telemetry import Ap, Message, Telemetry
from sitl.report import FlightLog
from sitl.vehicle.config import SIGNING_TICK_NS

PARAM_PERIOD_NS = 4 * NS_PER_MS
Value = TypeVar("Value")
MAX_STATUSTEXT = 50


def by_message(**values: Value) -> dict[int, Value]:
    """Map message numbers of the dialect to values given by message name."""
    return {getattr(mav, f"MAVLINK_MSG_ID_{name}"): value for name, value in values.items()}


@dataclass(slots=True, kw_only=True)
class Stream:
    """One streamed message of a link."""

    interval_us: int
    due_ns: int  # next slot
    late_ns: int = 0  # ArduPilot: delay of the next message after its slot
    version: Hashable = None  # PX4: version of the topic when last sent


class Endpoint(ABC, Generic[Ap]):
    """Framing, messages by number and parameter list of one link during one boot.

    Each firmware adds its streams.
    """

    def __init__(self, ap: Ap, telemetry: Telemetry[Ap]) -> None:
        self._mav = mav.MAVLink(None, srcSystem=1, srcComponent=mav.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        if (signing := ap.config.signing) is not None:
            self._mav.signing.secret_key = signing.key
            self._mav.signing.timestamp = signing.timestamp + ap.boot_ns // SIGNING_TICK_NS
            self._mav.signing.sign_outgoing = True
        self._outgoing = bytearray()
        self._telemetry = telemetry
        self._ap = ap
        self._streams: dict[int, Stream] = {}
        self._text_id = 0
        self._queued_params: deque[int] = deque()
        self._param_due_ns = ap.now_ns

    def step(self, now_ns: int) -> None:
        """Queue due messages; ``now_ns`` is at most one control step ahead of the vehicle."""
        if self._queued_params and now_ns >= self._param_due_ns:
            self._param_due_ns = now_ns + PARAM_PERIOD_NS
            self.send_param(self._queued_params.popleft())
        for message_id in self._due():
            self.send_now(message_id)

    @abstractmethod
    def _due(self) -> list[int]:
        """Return the ids of the streamed messages to send now."""

    @abstractmethod
    def set_interval(self, message_id: int, interval_us: int) -> bool:
        """Change a stream. Return False if the firmware refuses."""

    def send_text(self, severity: int, text: str) -> None:
        """Send STATUSTEXT; number the chunks of a long text."""
        data = text.encode("ascii", "replace")
        if len(data) <= MAX_STATUSTEXT:
            self.send(mav.MAVLink_statustext_message(severity, data))
            return
        self._text_id = self._text_id % 65535 + 1
        for index, start in enumerate(range(0, len(data) + 1, MAX_STATUSTEXT)):
            chunk = data[start : start + MAX_STATUSTEXT]
            self.send(mav.MAVLink_statustext_message(severity, chunk, self._text_id, index))

    def parse(self, data: bytes) -> Iterator[Message]:
        """Yield the complete messages in these bytes; unreadable frames are skipped."""
        messages = self._mav.parse_buffer(data) or ()
        return (message for message in messages if message.get_type() != "BAD_DATA")

    def send(self, message: Message) -> None:
        self._mav.srcSystem = self._ap.system_id
        self._outgoing += message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256

    def pass_on(self, frame: bytes) -> None:
        self._outgoing += frame

    def take_outgoing(self) -> bytes:
        """Return everything queued since the last call: whole frames, in order."""
        taken = bytes(self._outgoing)
        self._outgoing.clear()
        return taken

    def send_now(self, message_id: int) -> bool:
        """Send one message if it has anything to report. Return False if it is unknown."""
        if message_id not in self._telemetry.names:
            return False
        if (message := self._telemetry.build(message_id)) is not None:
            self.send(message)
        return True

    def send_all_params(self) -> None:
        """Send every parameter from the first, at most 250 per second."""
        self._queued_params = deque(range(len(self._ap.params.names)))

    def send_param(self, index: int) -> None:
        """Send PARAM_VALUE; ``index`` must exist."""
        names = self._ap.params.names
        value = self._ap.params.on_wire(names[index])
        name = names[index].encode()
        self.send(mav.MAVLink_param_value_message(name, *value, len(names), index))


ACCEPTED: int = mav.MAV_RESULT_ACCEPTED
REJECTED: int = mav.MAV_RESULT_TEMPORARILY_REJECTED
DENIED: int = mav.MAV_RESULT_DENIED
UNSUPPORTED: int = mav.MAV_RESULT_UNSUPPORTED
FAILED: int = mav.MAV_RESULT_FAILED
FORCE = 21196.0  # param 2 of ARM_DISARM that overrides a refusal (MAVLink common.xml)

Link = TypeVar("Link", bound=Endpoint[Any])
Params7: TypeAlias = tuple[float, ...]
"""param1..7 of a command, the first at index 0; an unused one may be NaN."""


class MavlinkServer(ABC, Generic[Ap, Link]):
    """Receives on all links of one vehicle, and acts on the messages.

    ``on_NAME`` handles a message, given the link and the message. ``cmd_NAME`` handles a command,
    given its parameters and the link; it returns the MAV_RESULT of the ack.
    """

    bad_interval: ClassVar[int]
    """MAV_RESULT for an invalid message number or interval."""
    unknown_message: ClassVar[int]
    """MAV_RESULT for a request of an unknown message."""

    def __init__(self, ap: Ap, links: Sequence[Link], log: FlightLog) -> None:
        self.links = tuple(links)
        self.reboot_requested = False  # a command has requested a reboot
        self._ap = ap
        self._log = log
        self._arrived_ns = 0  # arrival of the message that is being handled

    def receive(self, link_id: int, data: bytes, arrived_ns: int) -> None:
        """Act on the bytes of one datagram, or of one read of a stream."""
        link = self.links[link_id]
        for message in link.parse(data):
            handler = getattr(self, f"on_{message.get_type().lower()}", None)
            if handler is not None and self._is_accepted(message):
                self._arrived_ns = arrived_ns
                handler(link, message)

    def step(self, now_ns: int) -> None:
        """Queue due messages and the vehicle's texts on every link. ``now_ns`` is at most one
        control step ahead of the vehicle."""
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
    def _announce(self) -> None:
        """Queue messages that precede the texts."""

    def on_command_long(self, link: Link, message: Message) -> None:
        entry = mav.enums["MAV_CMD"].get(message.command)
        name = entry.name.lower().removeprefix("mav_") if entry else ""
        handler: Callable[[Params7, Link], int] | None = getattr(self, name, None)
        params = tuple(float(getattr(message, f"param{n}")) for n in range(1, 8))
        result = UNSUPPORTED if handler is None else handler(params, link)
        sender = (message.get_srcSystem(), message.get_srcComponent())
        link.send(mav.MAVLink_command_ack_message(message.command, result, 0, 0, *sender))

    def cmd_set_message_interval(self, params: Params7, link: Link) -> int:
        if not all(map(math.isfinite, params[:2])):
            return self.bad_interval
        is_set = link.set_interval(int(params[0]), int(params[1]))
        return ACCEPTED if is_set else self.bad_interval

    def cmd_request_message(self, params: Params7, link: Link) -> int:
        if not math.isfinite(params[0]):
            return DENIED
        return ACCEPTED if link.send_now(int(params[0])) else self.unknown_message

    def on_param_request_list(self, link: Link, _message: Message) -> None:
        link.send_all_params()

    def on_param_request_read(self, link: Link, message: Message) -> None:
        index, names = message.param_index, self._ap.params.names
        if index < 0 and message.param_id in names:
            index = names.index(message.param_id)
        if 0 <= index < len(names):
            link.send_param(index)

    def on_param_set(self, link: Link, message: Message) -> None:
        if self._ap.params.set_on_wire(message.param_id, message.param_value):
            link.send_param(self._ap.params.names.index(message.param_id))

    def on_timesync(self, link: Link, message: Message) -> None:
        """Answer a request; answers (tc1 set) to our requests need no action."""
        if message.tc1 == 0:
            uptime_us = (self._arrived_ns - self._ap.boot_ns) // 1000
            link.send(mav.MAVLink_timesync_message(uptime_us * 1000, message.ts1))
