"""What an output is: how an action becomes a packet, and how the vehicle shows that it took it."""

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

from mavbridge.core.vehicle import Action, Output
from mavbridge.mavlink.codec.messages import Body
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.echo import EchoCheck, EchoFault, EchoRules, Shown
from mavbridge.mavlink.session.vehicle import VehicleSession


class Encoded(NamedTuple):
    """One action, ready to be sent."""

    packet: bytes
    action: Action
    """The action as the packet expresses it, in the policy's own terms."""
    shown: Shown
    """What the vehicle will show of it."""


class ActionOutput(ABC):
    """One message that carries actions, from the first packet to the release.

    Made when a policy is loaded. It outlives the sessions of the vehicle, so its methods are given
    the present one.
    """

    name: ClassVar[Output]
    is_sticks: ClassVar[bool]
    """Its actions are stick positions, and not setpoints."""
    hides_receiver: ClassVar[bool] = False
    """RC_CHANNELS shows our sticks in place of the receiver's."""
    releases: ClassVar[int]
    """Packets that take the last action back; 0: silence alone does."""
    _rules: ClassVar[EchoRules]
    _echo_message: ClassVar[str]
    """Message in which the vehicle shows what it acts on."""
    _causes: ClassVar[dict[EchoFault, str]]
    """Likely reason of each fault, for the user."""

    def __init__(self, codec: Codec) -> None:
        self._codec = codec
        self.echo = EchoCheck(self._rules)

    def restart(self) -> None:
        """A new session of the vehicle begins: nothing was sent in it, or seen."""
        self.echo = EchoCheck(self._rules)

    @abstractmethod
    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """The packet of an action; None where the vehicle is not ready for it.

        Raises:
            CommandRefusedError: an action that must not be sent.
        """

    def sent(self, encoded: Encoded, now_ns: int) -> None:
        """Note what has left."""
        self.echo.sent(encoded.shown, now_ns)

    def receive(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Take a message of the vehicle, which may show an echo, before the session does."""
        self._compare(body, vehicle, arrived_ns)
        vehicle.is_receiver_hidden = self.hides_receiver and self.echo.has_sent
        vehicle.is_released = self.echo.is_released and not self.echo.is_sending

    @abstractmethod
    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Take an echo, if this is one."""

    @abstractmethod
    def release_packet(self, vehicle: VehicleSession) -> bytes | None:
        """One of ``releases``; None: there is nothing to take back."""

    @property
    def echo_confirmed(self) -> bool:
        """The vehicle was seen to act on our packets."""
        return self.echo.confirmed

    def overruled(self, now_ns: int) -> str | None:
        """The likely reason why it acts on something else than what we send, or None."""
        fault = self.echo.fault(now_ns)
        if fault is None or fault == "silent" or self.echo.is_unshown(now_ns):
            return None
        return f"the vehicle ignores our {self._noun}: {self._causes[fault]}"

    def unheard(self, now_ns: int) -> str | None:
        """The reason why our packets do not reach it, as far as can be told, or None."""
        fault = self.echo.fault(now_ns)
        if fault is not None and self.echo.is_unshown(now_ns):
            return f"no {self._echo_message} arrive to check our {self._noun} against"
        if fault == "silent":
            return f"the vehicle does not hear our {self._noun}: {self._causes[fault]}"
        return None

    @property
    def _noun(self) -> str:
        return "sticks" if self.is_sticks else "setpoints"
