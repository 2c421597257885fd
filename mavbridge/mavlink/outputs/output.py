"""Interface of an output: encodes actions, and checks their echo."""

from abc import ABC, abstractmethod
from typing import ClassVar, NamedTuple

from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import Action, Output, VehicleStatus
from mavbridge.mavlink.codec.messages import Body
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.echo import EchoCheck, EchoRules, Shown
from mavbridge.mavlink.session.vehicle import VehicleSession


class Encoded(NamedTuple):
    """One encoded action."""

    packet: bytes
    action: Action
    """Action as the packet expresses it, in the policy's terms."""
    shown: Shown | None
    """Expected echo; None: nothing to check."""


class ActionOutput(ABC):
    """One kind of message that carries actions, from the first packet to the release.

    Created when a policy is loaded. It outlives the sessions of the vehicle, so its methods take
    the present one.
    """

    name: Output
    is_sticks: ClassVar[bool]
    """True if the actions are sticks, False if they are setpoints."""
    releases: ClassVar[int]
    """Number of packets that release the last action; 0: silence is the release."""
    _echo_message: ClassVar[str]
    """Message that shows the input that the vehicle acts on."""

    def __init__(self, codec: Codec, rules: EchoRules) -> None:
        self._codec = codec
        self._rules = rules
        self.echo = EchoCheck(rules)
        self.was_confirmed = False
        """True if the vehicle has ever been seen to act on our packets."""
        self._is_checked = True
        """False while no echo is to be expected."""

    def restart(self) -> None:
        """Start a new session of the vehicle, in which nothing was sent or seen."""
        self.echo = EchoCheck(self._rules)

    @abstractmethod
    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """Encode an action; None before the vehicle is ready, CommandRefusedError if refused."""

    def sent(self, encoded: Encoded, now_ns: int) -> None:
        """Note an action that was sent."""
        if encoded.shown is not None:
            self.echo.sent(encoded.shown, now_ns)

    def receive(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Process a message of the vehicle, possibly an echo, before the session does."""
        self._compare(body, vehicle, arrived_ns)
        self.was_confirmed |= self.echo.confirmed

    @abstractmethod
    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Process the message if it is an echo."""

    def last_sticks(self, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """Return sticks to send before the first release, or None."""
        return None

    def must_release(self, sent: int, now_ns: int) -> bool:
        """True if another packet has to follow the ``sent`` ones of a release."""
        return sent < self.releases

    def release_packet(self, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """Encode one of the ``releases``; return None if there is nothing to release."""
        return None

    def released(self) -> None:
        """Note that nothing more is sent until the next action."""
        self.echo.released()

    @property
    def echo_confirmed(self) -> bool:
        """True if the vehicle was seen to act on our packets, or shows no echo now."""
        return self.echo.confirmed or not self._is_checked

    def in_policy_terms(
        self, status: VehicleStatus | None, vehicle: VehicleSession, now_ns: int
    ) -> VehicleStatus | None:
        """Return the status with its sticks converted to the policy's."""
        return status

    def is_released(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """True if the vehicle acts on something other than our last packets, or none were sent."""
        return self.echo.is_released

    def are_sticks_at_rest(self, vehicle: VehicleSession) -> bool:
        """True if the vehicle does not take our last sticks for a pilot's hand."""
        return True

    def overruled(self, now_ns: int) -> Reason | None:
        """Return the likely reason why the vehicle acts on another source than us, or None."""
        fault = self.echo.fault(now_ns)
        if fault is None or fault == "silent" or self.echo.is_unshown(now_ns):
            return None
        return because(Code.OVERRULED, quantity=self._noun, output=self.name, fault=fault)

    def unheard(self, now_ns: int) -> Reason | None:
        """Return the likely reason why our packets do not reach the vehicle, or None."""
        fault = self.echo.fault(now_ns)
        if fault is not None and self.echo.is_unshown(now_ns):
            return because(Code.NO_ECHO, message=self._echo_message, quantity=self._noun)
        if fault == "silent":
            return because(Code.UNHEARD, quantity=self._noun, output=self.name, fault=fault)
        return None

    @property
    def _noun(self) -> str:
        return "sticks" if self.is_sticks else "setpoints"
