"""Choice of the flight's output, and sending of actions and releases through it."""

from collections.abc import Iterable, Iterator
from contextlib import suppress
from copy import copy

from mavbridge.core.clock import NS_PER_MS, Clock
from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import (
    Action,
    ActionKind,
    ActionMeaning,
    Decision,
    Output,
    Release,
)
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.output import ActionOutput
from mavbridge.mavlink.outputs.setpoints import AttitudeOutput, VelocityOutput
from mavbridge.mavlink.outputs.sticks import ManualControlOutput, OverrideOutput
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.mavlink.transport.connection import Connection

RELEASE_SPACING_NS = 50 * NS_PER_MS
LEVELS = 2
"""Packets of an output's ``last_sticks``: the link may lose one. A third would leave later than 100
ms after a takeover."""
CARRIED: dict[Output, ActionKind] = {
    "rc-override": "sticks",
    "manual-control": "sticks",
    "attitude": "attitude",
    "rates": "rates",
    "velocity": "velocity",
}
"""Kind of action that each output carries."""


def choose_output(
    meaning: ActionMeaning, wanted: Output | None, profile: Profile, codec: Codec
) -> ActionOutput:
    """Return the output asked for, or the default; raise PeerError if it does not fit."""
    usual = profile.usual_output(meaning.kind)
    name = wanted or usual
    if CARRIED[name] != meaning.kind:
        raise PeerError(
            f"--output {name} carries {CARRIED[name]}, and the actions of this policy are "
            f"{meaning.kind}: use --output auto, which is {usual} here"
        )
    if name != usual:
        raise PeerError(profile.refusal)
    match name:
        case "rc-override":
            return OverrideOutput(codec, meaning.stick_gains)
        case "manual-control":
            return ManualControlOutput(codec, meaning.stick_gains)
        case "velocity":
            return VelocityOutput(codec, meaning)
        case "attitude" | "rates":
            return AttitudeOutput(codec, meaning, profile, name)


class ActionSender:
    """Sends actions through the flight's output; a release that failed goes before all packets."""

    def __init__(self, connection: Connection, codec: Codec, clock: Clock) -> None:
        self._connection, self._codec, self._clock = connection, codec, clock
        self._flight: tuple[ActionMeaning, Output | None] | None = None
        """Meaning of the policy's actions, and the requested output; None: no policy is loaded."""
        self._vehicle: VehicleSession | None = None
        self._releases: int | None = None
        """Number of packets of the release since the last action; None: nothing was sent."""
        self._release_due_ns = 0
        """Time of the next one."""
        self.is_release_owed = False
        """True if a release could not be sent: call ``try_release`` before everything else."""
        self.output: ActionOutput | None = None
        """None until vehicle and policy are known."""

    def begin_flight(self, meaning: ActionMeaning, wanted: Output | None) -> None:
        """Choose the output, now or once the vehicle is known; raise PeerError if it cannot be."""
        self._flight, self.output = (meaning, wanted), None
        if self._vehicle is not None:
            self.equip(self._vehicle)

    def equip(self, vehicle: VehicleSession) -> None:
        """Fly this session of the vehicle from now on; raises as ``begin_flight`` does."""
        before, self._vehicle = self._vehicle, vehicle
        is_same_firmware = before is not None and before.profile is vehicle.profile
        if self.output is not None and is_same_firmware:
            self.output.restart()
        elif self._flight is not None:
            meaning, wanted = self._flight
            self.output = choose_output(meaning, wanted, vehicle.profile, self._codec)
        if self.output is not None:
            vehicle.use_output(self.output.name)

    def send(self, decision: Decision, decided_ns: int | None = None) -> Action | None:
        """Send an action or a release. Return the action as sent, or None.

        ``decided_ns``: time for which the action was computed; None: now.

        Raises:
            CommandRefusedError: this output must not send the action.
        """
        vehicle, output = self._vehicle, self.output
        if vehicle is None or output is None:
            return None
        if isinstance(decision, Release):
            self.try_release()
            return None
        made_ns = self._clock.now_ns() if decided_ns is None else decided_ns
        encoded = output.encode(decision, vehicle, made_ns)
        if encoded is None or (self.is_release_owed and not self.try_release()):
            return None
        # Before the send: a failed send may still go out.
        self._releases, self._release_due_ns = 0, 0
        if not self._connection.send(encoded.packet):
            # A lost connection is reported as such.
            if not self._connection.is_down and encoded.shown is not None:
                output.echo.tried(self._clock.now_ns())
            return None
        output.sent(encoded, self._clock.now_ns())
        return encoded.action

    def rehearse(
        self, plan: Iterable[tuple[int, Decision | None, str | None]]
    ) -> Iterator[tuple[int, bytes]]:
        """Yield delays [ns] and packets of resting decisions and mode requests, for later.

        Encoded by a copy of the output. A packet that cannot be encoded is skipped: whatever fails
        there fails in the flight, too, and must not end the guard here.
        """
        vehicle, output, now_ns = self._vehicle, copy(self.output), self._clock.now_ns()
        if vehicle is None or output is None:
            return
        with self._codec.rehearsing():
            for after_ns, decision, mode in plan:
                packet = None
                with suppress(Exception):
                    if isinstance(decision, Release):
                        packet = output.release_packet(vehicle, now_ns)
                    elif decision is not None:
                        encoded = output.encode(decision, vehicle, now_ns)
                        packet = None if encoded is None else encoded.packet
                if packet is not None:
                    yield after_ns, packet
                if mode is not None:
                    request = vehicle.profile.modes.command(mode)
                    yield after_ns, self._codec.encode_request(vehicle.identity.source, request)

    def try_release(self) -> bool:
        """Send the packet of a release that is due, the output's ``last_sticks`` first.

        Return False if it failed and must precede all others.
        """
        vehicle, output, now_ns = self._vehicle, self.output, self._clock.now_ns()
        if vehicle is None or output is None:
            return True
        sent, is_due = self._releases, now_ns >= self._release_due_ns
        if sent is None or not is_due or not output.must_release(sent, now_ns):
            output.released()
            return True
        level = output.last_sticks(vehicle, now_ns) if sent < LEVELS else None
        packet = output.release_packet(vehicle, now_ns) if level is None else level.packet
        is_sent = packet is None or self._connection.send(packet)
        if level is not None and is_sent and sent == 0:
            output.sent(level, now_ns)
        if level is None or is_sent:
            output.released()
        self.is_release_owed = not is_sent
        if is_sent:
            self._releases = sent + (packet is not None)
            self._release_due_ns = self._clock.now_ns() + RELEASE_SPACING_NS
        return is_sent

    def transmit(self, data: bytes) -> bool:
        """Send another packet, after an outstanding release. Return False if it was not sent."""
        if self.is_release_owed and not self.try_release():
            return False
        return self._connection.send(data)
