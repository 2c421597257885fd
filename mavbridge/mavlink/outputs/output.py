"""Shape of an output: an action becomes a packet, and the vehicle shows that it took it."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Mapping
from typing import ClassVar, NamedTuple

from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import Action, Output, VehicleStatus
from mavbridge.mavlink.codec.messages import Body
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.echo import EchoCheck, EchoFault, EchoRules, Shown
from mavbridge.mavlink.session.vehicle import VehicleSession


class Encoded(NamedTuple):
    """One action, ready to be sent."""

    packet: bytes
    action: Action
    """The action as the packet expresses it, in the policy's own terms."""
    shown: Shown | None
    """What the vehicle will show of it; None: nothing that could be checked."""


class ActionOutput(ABC):
    """One message that carries actions, from the first packet to the release.

    Made when a policy is loaded. It outlives the sessions of the vehicle, so its methods are given
    the present one.
    """

    name: Output
    is_sticks: ClassVar[bool]
    """Its actions are stick positions, and not setpoints."""
    hides_receiver: ClassVar[bool] = False
    """RC_CHANNELS shows our sticks in place of the receiver's."""
    releases: ClassVar[int]
    """Packets that take the last action back; 0: silence alone does."""
    _echo_message: ClassVar[str]
    """Message in which the vehicle shows what it acts on."""
    _causes: ClassVar[Mapping[EchoFault, str]]
    """Likely reason of each fault, for the user."""

    def __init__(self, codec: Codec, rules: EchoRules) -> None:
        self._codec = codec
        self._rules = rules
        self.echo = EchoCheck(rules)
        self.saturated: Counter[str] = Counter()
        """How often each stick, by name, asked for more than the vehicle can do."""
        self._was_confirmed = False

    def restart(self) -> None:
        """A new session of the vehicle begins: nothing was sent in it, or seen."""
        self._was_confirmed |= self.echo.confirmed
        self.echo = EchoCheck(self._rules)

    @property
    def was_confirmed(self) -> bool:
        """The vehicle was seen to act on our packets at some time."""
        return self._was_confirmed or self.echo.confirmed

    @abstractmethod
    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """The packet of an action; None where the vehicle is not ready for it.

        Raises:
            CommandRefusedError: an action that must not be sent.
        """

    def refused(self, encoded: Encoded, vehicle: VehicleSession, now_ns: int) -> None:
        """Note an action that could not be sent."""
        if encoded.shown is not None:
            self.echo.tried(now_ns)

    @abstractmethod
    def encode_resting(self, action: Action, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """The packet of an action at rest, for later: nothing is noted, and no dither is in it.

        Raises:
            CommandRefusedError: as ``encode``.
        """

    def sent(self, encoded: Encoded, vehicle: VehicleSession, now_ns: int) -> None:
        """Note what has left."""
        if encoded.shown is not None:
            self.echo.sent(encoded.shown, now_ns)

    def receive(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Take a message of the vehicle, which may show an echo, before the session does."""
        self._compare(body, vehicle, arrived_ns)
        if self.hides_receiver:
            vehicle.is_receiver_hidden = self.echo.has_sent
            vehicle.is_released = self.echo.is_released and not self.echo.is_sending

    @abstractmethod
    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Take an echo, if this is one."""

    def last_sticks(self, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """What goes ahead of the releases, by their spacing; None: nothing has to."""
        return None

    @abstractmethod
    def release_packet(self, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """One of ``releases``; None: there is nothing to take back."""

    def released(self) -> None:
        """Nothing more is sent until the next action."""
        self._was_confirmed |= self.echo.confirmed
        self.echo.released()

    @property
    def echo_confirmed(self) -> bool:
        """The vehicle was seen to act on our packets, or shows nothing of them now."""
        return self.echo.confirmed

    def take_notes(self) -> tuple[str, ...]:
        """What the user should know, each once."""
        return ()

    def in_policy_terms(
        self, status: VehicleStatus | None, vehicle: VehicleSession, now_ns: int
    ) -> VehicleStatus | None:
        """The status with its sticks as the policy would mean them."""
        return status

    def is_released(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """It acts on something else than our last packets, or was sent none."""
        return self.echo.is_released

    @property
    def shows_last(self) -> bool:
        """What it shows since the release is, or cannot be told from, our last."""
        return self.echo.shows_last

    def are_sticks_at_rest(self, vehicle: VehicleSession) -> bool:
        """The vehicle takes what we last sent for nobody's hand."""
        return True

    def overruled(self, now_ns: int) -> Reason | None:
        """The likely reason why it acts on something else than what we send, or None."""
        fault = self.echo.fault(now_ns)
        if fault is None or fault == "silent" or self.echo.is_unshown(now_ns):
            return None
        return because(Code.OVERRULED, quantity=self._noun, cause=self._causes[fault])

    def unheard(self, now_ns: int) -> Reason | None:
        """The reason why our packets do not reach it, as far as can be told, or None."""
        fault = self.echo.fault(now_ns)
        if fault is not None and self.echo.is_unshown(now_ns):
            return because(Code.NO_ECHO, message=self._echo_message, quantity=self._noun)
        if fault == "silent":
            return because(Code.UNHEARD, quantity=self._noun, cause=self._causes[fault])
        return None

    @property
    def _noun(self) -> str:
        return "sticks" if self.is_sticks else "setpoints"
