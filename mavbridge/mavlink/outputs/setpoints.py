"""Common part of the outputs for setpoints: modes that follow them, and release by silence."""

from collections.abc import Mapping
from typing import ClassVar

from mavbridge.core.clock import NS_PER_S
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.echo import EchoFault, EchoRules
from mavbridge.mavlink.outputs.output import ActionOutput, Encoded
from mavbridge.mavlink.session.vehicle import VehicleSession

HELD_NS = 3 * NS_PER_S
"""Longest that a vehicle goes on with the last setpoint: ArduPilot's GUID_TIMEOUT by default;
PX4's COM_OF_LOSS_T is 1 s."""
FOREIGN_SAMPLES = 5
"""A mode that takes over shows its own targets at once and its name within 30 ms, and five samples
come in 50 to 100 ms: a change of mode is told as what it is."""


class SetpointOutput(ActionOutput):
    """Setpoints. Nothing but a mode takes the vehicle away from the last one, so the release is
    silence; nothing is ever repeated by itself.

    The echo is checked while the vehicle is armed, in the air and in a mode that follows setpoints;
    in every other state it rightly shows something else.
    """

    is_sticks = False
    releases = 0
    takeoff_ns: ClassVar[int] = 0
    """So long after the ground it may rightly show something else."""
    _causes: ClassVar[Mapping[EchoFault, str]] = {
        "unseen": "another station may be commanding it",
        "foreign": "another station commands it as well, or it limits or refuses them",
        "returned": "it goes back to what it did before us",
        "silent": "its target has stood still for 0.4 s while ours moved",
    }

    def __init__(self, codec: Codec, rules: EchoRules) -> None:
        super().__init__(codec, rules)
        self._sent_ns: int | None = None
        self._ground_ns: int | None = None
        """When it last stood on the ground, as far as we have sent anything there."""
        self._is_checked = False

    def restart(self) -> None:
        """A new session: nothing was sent in it."""
        super().restart()
        self._sent_ns, self._ground_ns, self._is_checked = None, None, False

    def _follows(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """The vehicle is armed and in a mode that follows setpoints."""
        status = vehicle.status(now_ns)
        roles = vehicle.profile.modes.roles
        return status is not None and status.armed and status.mode in roles.setpoint

    def _is_taking_off(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """The vehicle is on the ground, or has only just left it."""
        status = vehicle.status(now_ns)
        if status is not None and status.is_landed is True:
            self._ground_ns = now_ns
        return self._ground_ns is not None and now_ns - self._ground_ns <= self.takeoff_ns

    def _has_echo(self, encoded: Encoded, vehicle: VehicleSession, now_ns: int) -> bool:
        is_taking_off = self._is_taking_off(vehicle, now_ns)
        return encoded.shown is not None and self._follows(vehicle, now_ns) and not is_taking_off

    def refused(self, encoded: Encoded, vehicle: VehicleSession, now_ns: int) -> None:
        """Note an action that could not be sent."""
        if self._has_echo(encoded, vehicle, now_ns):
            super().refused(encoded, vehicle, now_ns)

    def sent(self, encoded: Encoded, vehicle: VehicleSession, now_ns: int) -> None:
        """Note what has left, for the echo where there is one to expect."""
        self._sent_ns = now_ns
        self._is_checked = self._has_echo(encoded, vehicle, now_ns)
        if self._is_checked and encoded.shown is not None:
            self.echo.sent(encoded.shown, now_ns)
        else:
            super().released()

    def released(self) -> None:
        """Silence."""
        super().released()
        self._is_checked = False

    @property
    def echo_confirmed(self) -> bool:
        """Its target was ours, or it follows no setpoints now."""
        return self.echo.confirmed or not self._is_checked

    def is_released(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """Another mode has taken over, or it holds by itself after its own timeout."""
        if self._sent_ns is None:
            return True
        is_over = now_ns - self._sent_ns > HELD_NS
        return not self.echo.is_sending and (is_over or not self._follows(vehicle, now_ns))

    @property
    def shows_last(self) -> bool:
        """Never: what it shows tells nothing about a release."""
        return False

    def release_packet(self, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """Silence is the release."""
        return None
