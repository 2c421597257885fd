"""Sends actions and releases through the output of the flight."""

from mavbridge.core.clock import Clock
from mavbridge.core.vehicle import Action, ActionMeaning, Decision, Output, Release
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.choice import choose_output
from mavbridge.mavlink.outputs.output import ActionOutput
from mavbridge.mavlink.outputs.release import ReleasePlan
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.mavlink.transport.connection import Connection


class ActionSender:
    """The output of the flight, once both the vehicle and the policy are known.

    A release that could not be sent goes before every other packet.
    """

    def __init__(self, connection: Connection, codec: Codec, clock: Clock) -> None:
        self._connection, self._codec, self._clock = connection, codec, clock
        self._flight: tuple[ActionMeaning, Output | None] | None = None
        """The policy's actions, and the output that was asked for; None = no policy is loaded."""
        self._vehicle: VehicleSession | None = None
        self._release = ReleasePlan()
        self.output: ActionOutput | None = None
        """None until both are known."""

    def begin_flight(self, meaning: ActionMeaning, wanted: Output | None) -> None:
        """Choose the output for such actions, now or once the vehicle is known.

        Raises:
            PeerError: the vehicle cannot be flown with it.
        """
        self._flight, self.output = (meaning, wanted), None
        if self._vehicle is not None:
            self.equip(self._vehicle)

    def equip(self, vehicle: VehicleSession) -> None:
        """Fly this session of the vehicle from now on; raises as ``begin_flight``."""
        self._vehicle = vehicle
        if self.output is not None:
            self.output.restart()
        elif self._flight is not None:
            meaning, wanted = self._flight
            self.output = choose_output(meaning, wanted, vehicle.profile, self._codec)
        if self.output is not None:
            vehicle.use_output(self.output.name)

    @property
    def is_release_owed(self) -> bool:
        """A release could not be sent: ``try_release`` before everything else."""
        return self._release.is_owed

    def send(self, decision: Decision, decided_ns: int | None = None) -> Action | None:
        """Send an action or a release; returns the action as it was really sent, or None.

        ``decided_ns``: the moment that the action was decided for, by which it is made; None: now.

        Raises:
            CommandRefusedError: an action that this output must not send.
        """
        vehicle, output = self._vehicle, self.output
        if vehicle is None or output is None:
            return None
        if isinstance(decision, Release):
            self._level(output, vehicle)
            output.released()
            if self._release.is_due(self._clock.now_ns()):
                self.try_release()
            return None
        made_ns = self._clock.now_ns() if decided_ns is None else decided_ns
        encoded = output.encode(decision.action, vehicle, made_ns)
        if encoded is None or (self._release.is_owed and not self.try_release()):
            return None
        self._release.acted(output.releases)
        if not self._connection.send(encoded.packet):
            if not self._connection.is_down:  # which is told as that
                output.refused(encoded, vehicle, self._clock.now_ns())
            return None
        output.sent(encoded, vehicle, self._clock.now_ns())
        return encoded.action

    def rehearse(self, decision: Decision) -> bytes | None:
        """The packet of an action at rest or of a release, for later: nothing is noted."""
        vehicle, output, now_ns = self._vehicle, self.output, self._clock.now_ns()
        if vehicle is None or output is None:
            return None
        if isinstance(decision, Release):
            return output.release_packet(vehicle, now_ns)
        return output.encode_resting(decision.action, vehicle, now_ns)

    def _level(self, output: ActionOutput, vehicle: VehicleSession) -> None:
        """Send what goes ahead of the first release, where the output has it."""
        if self._release.left < output.releases:
            return  # not the first
        now_ns = self._clock.now_ns()
        encoded = output.last_sticks(vehicle, now_ns)
        if encoded is not None and self._connection.send(encoded.packet):
            output.sent(encoded, vehicle, now_ns)
            self._release.tried(now_ns, is_sent=True)

    def try_release(self) -> bool:
        """Send a release; False: it was not sent, and goes before all other packets."""
        vehicle, output = self._vehicle, self.output
        if vehicle is None or output is None:
            return True
        packet = output.release_packet(vehicle, self._clock.now_ns())
        is_sent = packet is None or self._connection.send(packet)
        self._release.tried(self._clock.now_ns(), is_sent=is_sent)
        return is_sent

    def transmit(self, data: bytes) -> bool:
        """Send another packet, after a release that is owed; False: it was not sent."""
        if self._release.is_owed and not self.try_release():
            return False
        return self._connection.send(data)
