"""A link's part that both firmwares share: messages by number, and the list of parameters."""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Generic, Protocol, TypeVar

from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.clock import NS_PER_MS
from sitl.link.framing import Framing, Message
from sitl.vehicle.config import SigningKey

PARAM_PERIOD_NS = 4 * NS_PER_MS
MAX_STATUSTEXT = 50


class WireParams(Protocol):
    """Parameters as PARAM_VALUE carries them."""

    @property
    def names(self) -> tuple[str, ...]:
        """All names, in the order of their index."""
        ...

    def integer(self, name: str) -> int:
        """The value of an integer."""
        ...

    def on_wire(self, name: str) -> float:
        """The value as the float of the message."""
        ...


class Served(Protocol):
    """The part of an autopilot that every link needs."""

    now_ns: int

    @property
    def params(self) -> WireParams:
        """Its parameters."""
        ...


Ap = TypeVar("Ap", bound=Served)


class VehicleEndpoint(Framing, Generic[Ap]):
    """Sends for one autopilot of a firmware; its constructor ends with the first ``_serve``."""

    def __init__(
        self,
        builders: Mapping[int, Callable[[Ap], Message | None]],
        id_param: str,
        signing: SigningKey | None,
    ) -> None:
        """``id_param`` is the firmware's parameter of the vehicle's system id."""
        super().__init__(signing)
        self._builders = builders
        self._id_param = id_param

    def _serve(self, ap: Ap) -> None:
        """Begin with a vehicle that has just booted."""
        self._ap = ap
        self._queued_params: deque[int] = deque()
        self._param_due_ns = ap.now_ns

    def send(self, message: Message) -> None:
        """Queue a message."""
        self.pack(message, self._ap.params.integer(self._id_param))

    def send_now(self, message_id: int) -> bool:
        """Send one message, unless it has nothing to report yet; False if it is unknown."""
        build = self._builders.get(message_id)
        message = build(self._ap) if build else None
        if message is not None:
            self.send(message)
        return build is not None

    def send_all_params(self) -> None:
        """Send every parameter from the first, a few hundred a second."""
        self._queued_params = deque(range(len(self._ap.params.names)))

    def send_param(self, index: int) -> None:
        """Send PARAM_VALUE; ``index`` must exist."""
        params = self._ap.params
        name = params.names[index]
        self.send(
            mav.MAVLink_param_value_message(
                name.encode(), params.on_wire(name), self._kind(name), len(params.names), index
            )
        )

    def _kind(self, name: str) -> int:
        """MAV_PARAM_TYPE of a parameter."""
        return int(mav.MAV_PARAM_TYPE_REAL32)

    def _send_next_param(self, now_ns: int) -> None:
        """Send one of the list, if it is due."""
        if self._queued_params and now_ns >= self._param_due_ns:
            self._param_due_ns = now_ns + PARAM_PERIOD_NS
            self.send_param(self._queued_params.popleft())
