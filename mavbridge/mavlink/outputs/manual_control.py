"""Sticks by MANUAL_CONTROL: PX4."""

from typing import ClassVar

from mavbridge.core.vehicle import Action, Output, Sticks
from mavbridge.mavlink.codec.messages import Body
from mavbridge.mavlink.codec.packets import CommandRefusedError, manual_control_sticks
from mavbridge.mavlink.outputs.echo import EchoFault, EchoRules
from mavbridge.mavlink.outputs.output import ActionOutput, Encoded
from mavbridge.mavlink.session.vehicle import VehicleSession


class ManualControlOutput(ActionOutput):
    """MANUAL_CONTROL; silence is the release."""

    name: ClassVar[Output] = "manual-control"
    is_sticks = True
    releases = 0
    _rules = EchoRules(tolerance=1, nudged=1, nudge=2, seek_nudge=4, centre=0)
    _echo_message = "MANUAL_CONTROL"
    _causes: ClassVar[dict[EchoFault, str]] = {}

    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """The four sticks, rounded."""
        if not isinstance(action, Sticks):
            raise CommandRefusedError(f"{type(action).__name__} are not sticks")
        packet = self._codec.encode_manual_control(vehicle.identity.source.system, action)
        return Encoded(packet, manual_control_sticks(action), ())

    def sent(self, encoded: Encoded, now_ns: int) -> None:
        """Nothing is checked."""

    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Nothing is checked."""

    def release_packet(self, vehicle: VehicleSession) -> bytes | None:
        """Silence is the release."""
        return None

    @property
    def echo_confirmed(self) -> bool:
        """Nothing is checked."""
        return True
