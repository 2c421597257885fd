"""Sticks by RC_CHANNELS_OVERRIDE, with their echo in RC_CHANNELS: ArduPilot."""

from collections.abc import Mapping
from typing import ClassVar

from mavbridge.core.vehicle import NEUTRAL, Action, Output, StickGains, VehicleStatus
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import Body, RcChannels
from mavbridge.mavlink.codec.packets import Codec, pwm_of
from mavbridge.mavlink.outputs.echo import EchoFault, EchoRules, Shown
from mavbridge.mavlink.outputs.output import Encoded
from mavbridge.mavlink.outputs.sticks import StickOutput
from mavbridge.mavlink.session.vehicle import VehicleSession

OVERRIDE_ECHO = EchoRules(tolerance=2, dithered=3, dither=1, seek_dither=4, centre=1500)
"""In us. A receiver at rest moves by 2; the vehicle itself shows overrides to the microsecond.

Roll is dithered: 1500, 1501 and 1502 us were seen to move nothing, inside the dead zone of 20 us;
beyond it, 2 us are 0.2 degrees of lean at the usual calibration. Two of the larger steps are well
inside the dead zone.
"""


class OverrideOutput(StickOutput):
    """RC_CHANNELS_OVERRIDE; a release gives the channels back to the receiver.

    Without a receiver ArduPilot keeps the last sticks after a release, until its radio failsafe a
    second later, or for ever with FS_THR_ENABLE 0: level ones go ahead of it there.
    """

    name: Output = "rc-override"
    hides_receiver = True
    releases = 80
    """Over the four seconds for which they are asked for at most; then silence, so that another
    station may override."""
    _echo_message = "RC_CHANNELS"
    _causes: ClassVar[Mapping[EchoFault, str]] = {
        "unseen": "another station may be overriding them, or the receiver has priority",
        "foreign": "another station is overriding them (a joystick on our system id?)",
        "returned": "it also acts on the sticks that it had before us: another station is "
        "overriding or releasing them, or the override switch is off",
        "silent": "its sticks have stood still for 0.4 s while ours moved",
    }

    def __init__(self, codec: Codec, gains: StickGains | None) -> None:
        super().__init__(codec, OVERRIDE_ECHO, gains)
        self._calibration: RcCalibration | None = None
        """Calibration of the last override, for its release even after a reboot of the vehicle."""
        self._last: Shown = (0, 0, 0, 0)
        """The last override in us: throttle, yaw, pitch, roll."""
        self._status: VehicleStatus | None = None
        """The vehicle's last one, also after its session has started over."""

    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """The override of the four sticks; None without a calibration."""
        sticks, curves = self._wanted(action, vehicle, now_ns)
        calibration = vehicle.calibration
        if calibration is None:
            return None
        shown = self.echo.with_dither(pwm_of(sticks, calibration), now_ns)
        throttle, yaw, pitch, roll = shown
        pwm_us = (throttle, yaw, pitch, roll)
        packet = self._codec.encode_override(vehicle.identity.source, pwm_us, calibration)
        self._calibration, self._last = calibration, pwm_us
        return Encoded(packet, curves.to_policy(calibration.to_sticks(pwm_us)), shown)

    def encode_resting(self, action: Action, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """See `ActionOutput`."""
        if (calibration := vehicle.calibration) is None:
            return None
        pwm_us = pwm_of(self._resting(action), calibration)
        return self._codec.encode_override(vehicle.identity.source, pwm_us, calibration)

    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Compare RC_CHANNELS with what was sent."""
        if isinstance(body, RcChannels) and vehicle.calibration is not None:
            pwm_us = vehicle.calibration.stick_channels_us(body.channels_us)
            if pwm_us is not None:
                self.echo.received(pwm_us, body.boot_us, arrived_ns)

    def in_policy_terms(
        self, status: VehicleStatus | None, vehicle: VehicleSession, now_ns: int
    ) -> VehicleStatus | None:
        """The status with its sticks as the policy would mean them."""
        self._status = status or self._status
        return super().in_policy_terms(status, vehicle, now_ns)

    def last_sticks(self, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """Level ones for an armed vehicle without a receiver; where the throttle is thrust, with
        the last one.

        None once a failsafe has chosen its mode: sticks clear a radio failsafe, and it would fire
        again a second later, whatever mode the pilot has set by then.
        """
        status, calibration = vehicle.status(now_ns) or self._status, self._calibration
        if status is None or calibration is None or not status.armed:
            return None
        roles = vehicle.profile.modes.roles
        is_brought_down = status.is_failsafe and status.mode in (roles.hold, roles.land, roles.rtl)
        if status.has_receiver or is_brought_down:
            return None
        throttle, yaw, pitch, roll = pwm_of(NEUTRAL, calibration)
        if status.mode in roles.thrust:
            throttle = self._last[0]
        pwm_us = (throttle, yaw, pitch, roll)
        packet = self._codec.encode_override(vehicle.identity.source, pwm_us, calibration)
        return Encoded(packet, calibration.to_sticks(pwm_us), pwm_us)

    def release_packet(self, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """Give the four channels back."""
        if self._calibration is None:
            return None
        return self._codec.encode_release(vehicle.identity.source, self._calibration)
