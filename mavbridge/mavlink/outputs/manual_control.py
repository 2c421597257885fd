"""Sticks by MANUAL_CONTROL, with their echo in the vehicle's own MANUAL_CONTROL: PX4."""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.vehicle import Action, Output, StickGains, Sticks, VehicleStatus
from mavbridge.mavlink.codec.messages import STICK_END, Body, ManualControl
from mavbridge.mavlink.codec.packets import Codec, manual_control_of, manual_control_sticks
from mavbridge.mavlink.outputs.echo import EchoFault, EchoRules
from mavbridge.mavlink.outputs.output import Encoded
from mavbridge.mavlink.outputs.sticks import StickOutput
from mavbridge.mavlink.session.vehicle import VehicleSession

MANUAL_ECHO = EchoRules(
    tolerance=1,
    release_tolerance=1,
    dithered=3,
    dither=2,
    seek_dither=4,
    centre=0,
    longest_pause_ns=450 * NS_PER_MS,
)
"""x, y, z, r. PX4 shows the sticks as they came, or one less (rounded down), at the rate at which
they came: it shows nothing when it hears nothing.

The dither is on r, whose dead zone is a tenth; outside it 4 are half a degree a second.
"""
_MODES = ("ALTCTL", "POSCTL", "MANUAL", "STABILIZED", "ACRO")
"""In all others the last sticks do nothing, but one that jumps may be taken for the pilot's hand,
which ends the mode."""
_HELD_NS = 700 * NS_PER_MS
"""PX4 holds the last sticks for 0.5 s and a poll of 0.2 s (COM_RC_LOSS_T); echoes end with them."""


_SPEED_TAU_S = 0.1
"""Of PX4's low-pass of a stick's speed (``MovingDiff``); that of 1.18 is faster."""
_REST_SHARE = 0.5
"""Of a hand's speed. A jump that PX4 sees 70 ms later, since packets were lost, is below it too."""


class StickSpeeds:
    """Speed of the sticks that were sent, as PX4's detector of a pilot's hand computes it."""

    def __init__(self) -> None:
        self._last: ManualControl | None = None
        self._at_ns = 0
        self._per_s: tuple[float, ...] = (0.0,) * 4

    @property
    def fastest_per_s(self) -> float:
        """Full sticks a second."""
        return max(map(abs, self._per_s))

    def sent(self, values: ManualControl, now_ns: int) -> None:
        """Take sticks that have left."""
        last, dt_s = self._last, (now_ns - self._at_ns) / NS_PER_S
        self._last, self._at_ns = values, now_ns
        if last is None or dt_s <= 0.0:
            return
        x, y, z, r = (value - before for value, before in zip(values, last, strict=True))
        weight = dt_s / (_SPEED_TAU_S + dt_s)
        moves = (x, y, 2 * z, r)  # z runs over half the range
        self._per_s = tuple(
            speed + weight * (move / STICK_END / dt_s - speed)
            for speed, move in zip(self._per_s, moves, strict=True)
        )


class ManualControlOutput(StickOutput):
    """MANUAL_CONTROL. There is no release: one neutral packet where nobody else has sticks, then
    silence, which PX4 takes for lost sticks where it had only ours."""

    name: Output = "manual-control"
    releases = 1
    _echo_message = "MANUAL_CONTROL"
    _causes: ClassVar[Mapping[EchoFault, str]] = {
        "unseen": "it has other sticks (a receiver, or a joystick on another link) and keeps them "
        "(COM_RC_IN_MODE)",
        "foreign": "another station sends sticks, or the receiver's have priority (COM_RC_IN_MODE)",
        "returned": "it also acts on the sticks that it had before us (COM_RC_IN_MODE)",
        "silent": "its sticks have stood still for 0.4 s while ours moved",
    }

    def __init__(self, codec: Codec, gains: StickGains | None) -> None:
        super().__init__(codec, MANUAL_ECHO, gains)
        self._last = ManualControl(0, 0, STICK_END // 2, 0)
        self._sent_ns = 0
        self._speeds = StickSpeeds()
        self._shown: tuple[int, Sticks] | None = None
        """Arrival of the sticks that it acts on, and these."""
        self._pilot: Sticks | None = None
        """The same while it acted on none of ours."""
        self._status: VehicleStatus | None = None
        """The vehicle's last one, also after its session has started over."""

    def sent(self, encoded: Encoded, vehicle: VehicleSession, now_ns: int) -> None:
        """Note what has left."""
        super().sent(encoded, vehicle, now_ns)
        self._sent_ns = now_ns
        self._speeds.sent(self._last, now_ns)

    def are_sticks_at_rest(self, vehicle: VehicleSession) -> bool:
        """Slower than a hand, by the parameter that this version has."""
        hand_per_s = vehicle.profile.hand_per_s(vehicle.known_params)
        return self._speeds.fastest_per_s < _REST_SHARE * hand_per_s

    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """The four sticks, rounded."""
        sticks, curves = self._wanted(action, vehicle, now_ns)
        shown = self.echo.with_dither(manual_control_of(sticks), now_ns)
        x, y, z, r = shown
        values = ManualControl(x, y, z, r)
        packet = self._codec.encode_manual_control(vehicle.identity.source.system, values)
        self._last = values
        return Encoded(packet, curves.to_policy(manual_control_sticks(values)), shown)

    def encode_resting(self, action: Action, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """See `ActionOutput`."""
        values = manual_control_of(self._resting(action))
        return self._codec.encode_manual_control(vehicle.identity.source.system, values)

    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Compare the sticks that the vehicle acts on; they carry no stamp of its own."""
        if not isinstance(body, ManualControl):
            return
        self.echo.received(tuple(body), arrived_ns // 1000, arrived_ns)
        self._shown = (arrived_ns, manual_control_sticks(body))
        if self.echo.is_released and not self.echo.is_sending:
            self._pilot = self._shown[1]

    def in_policy_terms(
        self, status: VehicleStatus | None, vehicle: VehicleSession, now_ns: int
    ) -> VehicleStatus | None:
        """The status with the sticks that are shown by MANUAL_CONTROL, and never by RC_CHANNELS."""
        self._status = status or self._status
        if status is not None and self._shown is not None:
            arrived_ns, sticks = self._shown
            status = replace(
                status, rc_sticks=sticks, pilot_sticks=self._pilot, rc_arrived_ns=arrived_ns
            )
        return super().in_policy_terms(status, vehicle, now_ns)

    def release_packet(self, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """Level once more in a mode that follows sticks, unless a receiver has some of its own;
        where the throttle is thrust, with the last one.

        A vehicle whose session starts over has no status yet. Its reboot may be but a wrong stamp,
        and without this packet it would fly on with the policy's last sticks for COM_RC_LOSS_T.
        """
        status = vehicle.status(now_ns) or self._status
        if status is None or status.has_receiver or status.mode not in _MODES:
            return None
        z = self._last.z if status.mode in vehicle.profile.modes.roles.thrust else STICK_END // 2
        return self._codec.encode_manual_control(
            vehicle.identity.source.system, ManualControl(0, 0, z, 0)
        )

    def is_released(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """It shows other sticks, or none any more."""
        is_over = now_ns - self._sent_ns > _HELD_NS and self.echo.is_unshown(now_ns)
        return self.echo.is_released or (is_over and not self.echo.is_sending)
