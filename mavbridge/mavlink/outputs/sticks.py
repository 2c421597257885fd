"""Outputs for sticks: RC_CHANNELS_OVERRIDE (ArduPilot), MANUAL_CONTROL (PX4), with echoes."""

import math
from dataclasses import replace

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.switch import GAP_NS
from mavbridge.core.vehicle import (
    IDLE,
    NEUTRAL,
    Action,
    AdviceText,
    Output,
    StickGains,
    Sticks,
    VehicleStatus,
)
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import STICK_END, Body, ManualControl, RcChannels
from mavbridge.mavlink.codec.packets import Codec, CommandRefusedError, manual_control_of, pwm_of
from mavbridge.mavlink.outputs.echo import EchoRules, Shown
from mavbridge.mavlink.outputs.output import ActionOutput, Encoded
from mavbridge.mavlink.profiles.sticks import IDENTITY, StickCurves
from mavbridge.mavlink.session.vehicle import VehicleSession

_CURVES_NS = 500 * NS_PER_MS
"""Longest delay until a parameter change reaches the stick curves; a mode change does at once."""
_LOW_THROTTLE, _MOST_LOW_YAW = -0.5, 0.8
"""Largest yaw up to a throttle, in modes whose throttle is thrust. ArduPilot disarms there, in the
air too, after 2 s of yaw beyond 0.89 and throttle within RC3_DZ, 200 us at most (ARMING_RUDDER)."""


class StickOutput(ActionOutput):
    """Sticks, mapped so that the vehicle moves as it did in the policy's training."""

    is_sticks = True

    def __init__(self, codec: Codec, rules: EchoRules, gains: StickGains | None) -> None:
        super().__init__(codec, rules)
        self._gains = gains
        """None: send the sticks unchanged."""
        self._curves = IDENTITY
        self._curves_mode = ""
        self._curves_due_ns = 0
        self._status: VehicleStatus | None = None
        """Last status of the vehicle, kept when its session restarts."""

    def restart(self) -> None:
        """Start a new session, with its own parameters and mode."""
        super().restart()
        self._curves_mode, self._curves_due_ns = "", 0

    def in_policy_terms(
        self, status: VehicleStatus | None, vehicle: VehicleSession, now_ns: int
    ) -> VehicleStatus | None:
        """Return the status with its sticks converted to the policy's."""
        self._status = status or self._status
        if status is None:
            return None
        curves = self._curves_of(vehicle, status.mode, now_ns)
        if curves.is_identity or (status.rc_sticks is None and status.pilot_sticks is None):
            return status
        rc, pilot = (
            None if sticks is None else curves.to_policy(sticks)
            for sticks in (status.rc_sticks, status.pilot_sticks)
        )
        return replace(status, rc_sticks=rc, pilot_sticks=pilot)

    def _wanted(
        self, action: Action, vehicle: VehicleSession, now_ns: int
    ) -> tuple[Sticks, StickCurves]:
        """Return the vehicle's sticks, and the curves for the inverse.

        ``IDLE`` is not mapped: it means the stop at the bottom, for arming.
        """
        if not isinstance(action, Sticks):
            raise CommandRefusedError(f"{type(action).__name__} are not sticks")
        if action is IDLE:
            return action, IDENTITY
        status = vehicle.status(now_ns)
        mode = status.mode if status else ""
        curves = self._curves_of(vehicle, mode, now_ns)
        sticks = curves.to_vehicle(action)
        if mode in vehicle.profile.modes.roles.thrust and sticks.throttle <= _LOW_THROTTLE:
            sticks = sticks._replace(yaw=min(max(sticks.yaw, -_MOST_LOW_YAW), _MOST_LOW_YAW))
        return sticks, curves

    def _curves_of(self, vehicle: VehicleSession, mode: str, now_ns: int) -> StickCurves:
        if mode != self._curves_mode or now_ns >= self._curves_due_ns:
            self._curves_mode, self._curves_due_ns = mode, now_ns + _CURVES_NS
            self._curves = vehicle.profile.stick_curves(vehicle.params.values, mode, self._gains)
            for note in self._curves.notes if vehicle.params.is_read else ():
                vehicle.report(AdviceText(note))
        return self._curves


OVERRIDE_ECHO = EchoRules(tolerance=2, dithered=3, dither=1, seek_dither=4, centre=1500, hand=20)
"""Echo of PWM [us]. A receiver at rest moves by 2 us, in minutes by more; the vehicle echoes
overrides exactly.

Roll is dithered: 1500, 1501 and 1502 us moved nothing, inside the dead zone of 20 us. Outside it, 2
us are 0.2 degrees of lean at the usual calibration. Two of the larger steps also stay well inside
the dead zone.
"""


class OverrideOutput(StickOutput):
    """RC_CHANNELS_OVERRIDE; a release gives the channels back to the receiver.

    Without a receiver ArduPilot keeps the last sticks after a release, until its radio failsafe one
    second later, or for ever with FS_THR_ENABLE 0. Level sticks therefore precede that release.
    """

    name: Output = "rc-override"
    releases = 80
    """Four seconds; the silence that follows lets another station override."""
    _echo_message = "RC_CHANNELS"

    def __init__(self, codec: Codec, gains: StickGains | None) -> None:
        super().__init__(codec, OVERRIDE_ECHO, gains)
        self._calibration: RcCalibration | None = None
        """Calibration of the last override, for its release even after a reboot."""
        self._last: Shown = (0, 0, 0, 0)
        """Last override [us]: throttle, yaw, pitch, roll."""

    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """Encode the override of the four sticks; return None without a calibration."""
        sticks, curves = self._wanted(action, vehicle, now_ns)
        calibration = vehicle.params.calibration
        if calibration is None:
            return None
        if not self.echo.has_sent and (status := vehicle.status(now_ns)) and status.rc_channels_us:
            self.echo.showed(calibration.stick_channels_us(status.rc_channels_us))
        pwm_us = self.echo.with_dither(pwm_of(sticks, calibration), now_ns)
        packet = self._codec.encode_override(vehicle.identity.source, pwm_us, calibration)
        self._calibration, self._last = calibration, pwm_us
        return Encoded(packet, curves.to_policy(calibration.to_sticks(pwm_us)), pwm_us)

    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Compare RC_CHANNELS, which shows our sticks in place of the receiver's."""
        if isinstance(body, RcChannels) and vehicle.params.calibration is not None:
            pwm_us = vehicle.params.calibration.stick_channels_us(body.channels_us)
            self.echo.received(pwm_us, body.boot_us, arrived_ns)
        vehicle.condition.is_receiver_hidden = self.echo.has_sent
        vehicle.condition.is_released = self.echo.is_released and not self.echo.is_sending

    def must_release(self, sent: int, now_ns: int) -> bool:
        """True for a while, and as long as a vehicle with a receiver has not heard any."""
        has_receiver = self._status is not None and self._status.has_receiver is True
        return super().must_release(sent, now_ns) or (has_receiver and self.echo.is_deaf(now_ns))

    def last_sticks(self, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """Level an armed vehicle without a receiver, with the last throttle in thrust modes.

        Return None once a failsafe has chosen its mode: sticks would clear a radio failsafe, which
        would fire again a second later in any mode that the pilot has set by then.
        """
        status, calibration = vehicle.status(now_ns) or self._status, self._calibration
        if status is None or calibration is None or not status.armed:
            return None
        roles = vehicle.profile.modes.roles
        is_brought_down = status.is_failsafe and status.mode in (roles.hold, roles.land, roles.rtl)
        if status.has_receiver or is_brought_down:
            return None
        pwm_us = pwm_of(NEUTRAL, calibration)
        if status.mode in roles.thrust:
            pwm_us = (self._last[0], *pwm_us[1:])
        packet = self._codec.encode_override(vehicle.identity.source, pwm_us, calibration)
        return Encoded(packet, calibration.to_sticks(pwm_us), pwm_us)

    def release_packet(self, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """Encode the release of the four channels."""
        if self._calibration is None:
            return None
        return self._codec.encode_override(vehicle.identity.source, None, self._calibration)


MANUAL_ECHO = EchoRules(
    tolerance=1,
    release_tolerance=1,
    dithered=3,
    dither=2,
    seek_dither=4,
    centre=0,
    longest_pause_ns=450 * NS_PER_MS,
    silent_us=350_000,
    silent_samples=3,
    hand=20,
)
"""Echo of x, y, z, r. PX4 shows received sticks, or one less (rounded down), at the rate of
reception. Without news it repeats the last every 200 ms, until they count as lost after 600 ms.

The dither is on r, which has a dead zone of a tenth; outside it, 4 units are 0.5 degrees/s.
"""
_MODES = ("ALTCTL", "POSCTL", "MANUAL", "STABILIZED", "ACRO")
"""Modes flown by sticks. In other modes the last sticks do nothing, but a jump may be taken for the
pilot's hand, which ends the mode."""
_HELD_NS, _GONE_NS = 700 * NS_PER_MS, 200 * NS_PER_MS
"""Time for which PX4 holds and echoes the last sticks: 0.5 s (COM_RC_LOSS_T) + 0.2 s of polling;
pause in the echo after that time in which it holds none."""
_SPEED_TAU_S = 0.1
"""Time constant of PX4's low-pass of the stick speed (``MovingDiff``); 1.18 is faster."""
_REST_SHARE = 0.5
"""Fraction of a hand's speed that counts as rest; also covers a jump that PX4 sees 70 ms late."""


class ManualControlOutput(StickOutput):
    """MANUAL_CONTROL, whose release is one neutral packet, then silence: lost sticks to PX4."""

    name: Output = "manual-control"
    releases = 1
    _echo_message = "MANUAL_CONTROL"

    def __init__(self, codec: Codec, gains: StickGains | None) -> None:
        super().__init__(codec, MANUAL_ECHO, gains)
        self._last: Shown = (0, 0, STICK_END // 2, 0)
        """Last x, y, z, r that were sent, at ``_sent_ns``."""
        self._sent_ns = 0
        self._seen, self._speeds_per_s = [0, 0, 0, STICK_END], [0.0] * 4
        """Sent y, x, r, 2 z, and their speeds [full sticks/s] as PX4 sees them."""
        self._hand_per_s = math.inf
        self._shown: tuple[int, Sticks] | None = None
        """Arrival of the sticks that the vehicle acts on, and those sticks."""
        self._pilot: Sticks | None = None
        """Sticks that the vehicle acted on when they were not ours."""

    def sent(self, encoded: Encoded, now_ns: int) -> None:
        """Note sticks that were sent, and their speeds."""
        super().sent(encoded, now_ns)
        dt_s = (now_ns - self._sent_ns) / NS_PER_S
        self._last, self._sent_ns = encoded.shown or self._last, now_ns
        if dt_s <= 0.0:
            return
        x, y, z, r = self._last
        weight = dt_s / (_SPEED_TAU_S + dt_s)
        for k, value in enumerate((y, x, r, 2 * z)):  # z has half the range
            move, self._seen[k] = (value - self._seen[k]) / STICK_END, value
            self._speeds_per_s[k] += weight * (move / dt_s - self._speeds_per_s[k])
            if abs(self._speeds_per_s[k]) > self._hand_per_s:
                break  # PX4 looks at a stick only if those before it rest

    def are_sticks_at_rest(self, vehicle: VehicleSession) -> bool:
        """True if our sticks are slower than a hand, by this firmware version's parameter."""
        return max(map(abs, self._speeds_per_s)) < _REST_SHARE * vehicle.params.traits.hand_per_s

    def encode(self, action: Action, vehicle: VehicleSession, now_ns: int) -> Encoded | None:
        """Encode the four sticks, rounded."""
        sticks, curves = self._wanted(action, vehicle, now_ns)
        self._hand_per_s = vehicle.params.traits.hand_per_s
        shown = self.echo.with_dither(manual_control_of(sticks), now_ns)
        values = ManualControl._make(shown)
        packet = self._codec.encode_manual_control(vehicle.identity.source.system, values)
        return Encoded(packet, curves.to_policy(values.sticks), shown)

    def _compare(self, body: Body | None, vehicle: VehicleSession, arrived_ns: int) -> None:
        """Compare the sticks that the vehicle acts on; they have no timestamp of the vehicle."""
        if not isinstance(body, ManualControl):
            return
        self.echo.received(tuple(body), arrived_ns // 1000, arrived_ns)
        self._shown = (arrived_ns, body.sticks)
        if self.echo.is_released and not self.echo.is_sending:
            self._pilot = self._shown[1]

    def in_policy_terms(
        self, status: VehicleStatus | None, vehicle: VehicleSession, now_ns: int
    ) -> VehicleStatus | None:
        """Return the status with the sticks of MANUAL_CONTROL, never those of RC_CHANNELS."""
        if status is not None and self._shown is not None:
            arrived_ns, sticks = self._shown
            status = replace(
                status,
                rc_sticks=sticks if now_ns - arrived_ns <= GAP_NS else None,
                pilot_sticks=self._pilot,
                rc_arrived_ns=arrived_ns,
            )
        return super().in_policy_terms(status, vehicle, now_ns)

    def release_packet(self, vehicle: VehicleSession, now_ns: int) -> bytes | None:
        """Encode one level packet in modes flown by sticks, with the last throttle in thrust modes.

        Without it the vehicle would fly on with the policy's last sticks for COM_RC_LOSS_T; later
        it holds none, and none must reach a pilot. After a session restart the last known status
        counts: a reboot may be only a wrong timestamp.
        """
        status = vehicle.status(now_ns) or self._status
        is_over = now_ns - self._sent_ns > _HELD_NS
        if status is None or status.mode not in _MODES or is_over:
            return None
        z = self._last[2] if status.mode in vehicle.profile.modes.roles.thrust else STICK_END // 2
        level = ManualControl(0, 0, z, 0)
        return self._codec.encode_manual_control(vehicle.identity.source.system, level)

    def is_released(self, vehicle: VehicleSession, now_ns: int) -> bool:
        """True if the vehicle shows other sticks, or none any more."""
        is_over = now_ns - self._sent_ns > _HELD_NS and self.echo.is_unshown(now_ns, _GONE_NS)
        return self.echo.is_released or (is_over and not self.echo.is_sending)
