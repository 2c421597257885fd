"""One MAVLink link of a vehicle, without I/O: bytes in, messages out; messages in, bytes out."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Generic, TypeAlias, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_MS
from sitl.firmware import Autopilot

Message: TypeAlias = Any  # a pymavlink message (the library has no types)
Ap = TypeVar("Ap", bound=Autopilot)
Builders: TypeAlias = Mapping[int, Callable[[Ap], Message | None]]

PARAM_PERIOD_NS = 4 * NS_PER_MS
MAX_STATUSTEXT = 50


class Endpoint(ABC, Generic[Ap]):
    """Framing, messages by number, and the list of parameters; each firmware adds its streams.

    A restart of the vehicle leaves framing and sequence numbers alone.
    """

    def __init__(self, ap: Ap, builders: Builders[Ap]) -> None:
        """``builders`` make every message that can be streamed or requested; they return None
        where there is nothing to report yet."""
        self.bad_frames = 0
        """Garbage, truncated frames and wrong checksums; with a key also wrong signatures."""
        self._mav = mav.MAVLink(None, srcSystem=1, srcComponent=mav.MAV_COMP_ID_AUTOPILOT1)
        self._mav.robust_parsing = True
        if (signing := ap.config.signing) is not None:
            self._mav.signing.secret_key = signing.key
            self._mav.signing.timestamp = signing.timestamp
            self._mav.signing.sign_outgoing = True
        self._outgoing = bytearray()
        self._builders = builders
        self.restart(ap)

    def restart(self, ap: Ap) -> None:
        """Begin again with a vehicle that has just booted."""
        self._ap = ap
        self._queued_params: deque[int] = deque()
        self._param_due_ns = ap.now_ns

    @abstractmethod
    def step(self, now_ns: int) -> None:
        """Queue what is due; ``now_ns`` is at most one control step ahead of the vehicle."""

    @abstractmethod
    def interval_us(self, message_id: int) -> int:
        """The interval that MESSAGE_INTERVAL reports."""

    @abstractmethod
    def send_text(self, severity: int, text: str) -> None:
        """Send STATUSTEXT, in as many messages as the text needs."""

    def parse(self, data: bytes) -> Iterator[Message]:
        """Complete messages in these bytes; unreadable frames are counted and skipped."""
        for message in self._mav.parse_buffer(data) or ():
            if message.get_type() == "BAD_DATA":
                self.bad_frames += 1
            else:
                yield message

    def send(self, message: Message) -> None:
        """Queue a message of the vehicle."""
        self._mav.srcSystem = self._ap.system_id
        self._outgoing += message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256

    def pass_on(self, frame: bytes) -> None:
        """Queue another sender's frame as it is."""
        self._outgoing += frame

    def take_outgoing(self) -> bytes:
        """Everything queued since the last call: whole frames, in order."""
        taken = bytes(self._outgoing)
        self._outgoing.clear()
        return taken

    def send_now(self, message_id: int) -> bool:
        """Send one message, unless it has nothing to report yet; False if it is unknown."""
        build = self._builders.get(message_id)
        message = build(self._ap) if build else None
        if message is not None:
            self.send(message)
        return build is not None

    def send_interval(self, message_id: int) -> None:
        """Send MESSAGE_INTERVAL."""
        interval_us = self.interval_us(message_id)
        self.send(mav.MAVLink_message_interval_message(message_id, interval_us))

    def send_all_params(self) -> None:
        """Send every parameter from the first, a few hundred a second."""
        self._queued_params = deque(range(len(self._ap.params.names)))

    def send_param(self, index: int) -> None:
        """Send PARAM_VALUE; ``index`` must exist."""
        params = self._ap.params
        name = params.names[index]
        value = (params.on_wire(name), params.kind(name))
        count = len(params.names)
        self.send(mav.MAVLink_param_value_message(name.encode(), *value, count, index))

    def _send_next_param(self, now_ns: int) -> None:
        """Send one of the list, if it is due."""
        if self._queued_params and now_ns >= self._param_due_ns:
            self._param_due_ns = now_ns + PARAM_PERIOD_NS
            self.send_param(self._queued_params.popleft())
