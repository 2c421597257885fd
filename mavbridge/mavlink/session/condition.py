"""Condition of the vehicle apart from its motion: mode, receiver, estimator, landing, battery."""

from typing import TypeVar

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.switch import GAP_NS, RADIO_US
from mavbridge.core.vehicle import Sticks, VehicleStatus
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import (
    Altitude,
    Body,
    CurrentMode,
    EstimatorFlags,
    Event,
    Heartbeat,
    LandedState,
    LocalVelocity,
    RcChannels,
    SystemStatus,
)
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.session.vehicle_params import VehicleParams

_T = TypeVar("_T")
SETTLE_NS = 100 * NS_PER_MS
"""Time after a change reported by CURRENT_MODE or an EVENT in which a HEARTBEAT may predate it: the
autopilot reports the change before its heartbeats show it, and a network may swap packets."""

POSITION_FRESH_NS = 500 * NS_PER_MS
SLOW_FRESH_NS = 2 * NS_PER_S
"""Maximum age of landed state, estimator and battery, which arrive at 5 and 2 Hz."""
_STATUS_NS = NS_PER_MS
"""Validity of a computed status, unless a message arrives."""
_HORIZONTAL_POSITION = dialect.ESTIMATOR_POS_HORIZ_REL | dialect.ESTIMATOR_POS_HORIZ_ABS


class VehicleCondition:
    """Combines the slow messages of one vehicle into one ``VehicleStatus``."""

    def __init__(
        self, profile: Profile, params: VehicleParams, *, min_battery_percent: float
    ) -> None:
        self._profile, self._params = profile, params
        self._min_battery_percent = min_battery_percent
        self.heartbeat: tuple[int, Heartbeat] | None = None
        self._custom_mode = 0
        self._mode_ns: int | None = None
        self._is_armed = False
        self._armed_ns: int | None = None
        self._is_failsafe = self._is_mode_chosen = False
        self._changed_ns: int | None = None
        """Last change that CURRENT_MODE or an EVENT reported."""
        self._stick_override_ns: int | None = None
        self._stick_loss_ns: int | None = None
        self._rc: tuple[int, RcChannels, RcCalibration | None] | None = None
        """Arrival and body of the newest RC_CHANNELS, and the calibration that it was read by."""
        self._rc_sticks: Sticks | None = None
        self._pilot_sticks: Sticks | None = None
        self._newest: dict[type, tuple[int, Body]] = {}
        """Arrival and body of each other kind of message."""
        self.is_receiver_hidden = False
        """True if RC_CHANNELS may show our sticks in place of the receiver's."""
        self.is_released = True
        """True if other sticks than ours were seen since the release, or none of ours was sent."""
        self._is_rc_plausible: bool | None = None
        """True if RC_CHANNELS held a radio's sticks before our first override."""
        self._is_rc_healthy: bool | None = None
        """Receiver health by SYS_STATUS before our first override; None: not reported."""
        self.receiver_due_ns: int | None = None
        """Deadline for a receiver to appear; None until the streams are granted."""
        self._status: VehicleStatus | None = None
        self._status_ns = 0

    def receive(self, body: Body | None, arrived_ns: int) -> None:
        """Process a message."""
        self._status = None
        match body:
            case Heartbeat():
                self._receive_heartbeat(body, arrived_ns)
            case CurrentMode():
                self._receive_mode(body, arrived_ns)
            case RcChannels():
                self._receive_rc(body, arrived_ns)
            case Event(event_id):
                self._receive_event(event_id, arrived_ns)
            case None:
                pass
            case _:
                self._newest[type(body)] = (arrived_ns, body)
        if isinstance(body, SystemStatus) and not self.is_receiver_hidden:
            bit = dialect.MAV_SYS_STATUS_SENSOR_RC_RECEIVER
            if body.present & bit:
                self._is_rc_healthy = bool(body.healthy & bit)

    def _receive_heartbeat(self, body: Heartbeat, arrived_ns: int) -> None:
        is_first, self.heartbeat = self.heartbeat is None, (arrived_ns, body)
        changed_ns = self._changed_ns
        if changed_ns is not None and arrived_ns - changed_ns < SETTLE_NS and not is_first:
            return
        self._custom_mode, self._mode_ns, self._armed_ns = body.custom_mode, arrived_ns, arrived_ns
        self._is_armed = bool(body.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
        self._is_failsafe = body.system_status >= dialect.MAV_STATE_CRITICAL

    def _receive_mode(self, body: CurrentMode, arrived_ns: int) -> None:
        """Process CURRENT_MODE, which also shows that the vehicle has left a mode by itself."""
        if self.heartbeat is None:
            return
        self._mode_ns = arrived_ns
        if body.custom_mode != self._custom_mode:
            self._custom_mode, self._changed_ns = body.custom_mode, arrived_ns
        intended = body.intended_custom_mode
        self._is_mode_chosen = intended == body.custom_mode
        if self._is_armed and intended and intended != body.custom_mode:
            self._note_failsafe(arrived_ns)

    def _receive_event(self, event_id: int, arrived_ns: int) -> None:
        meaning = self._profile.events.get(event_id)
        if meaning is None or self.heartbeat is None:
            return
        if meaning.is_armed is not None:
            self._is_armed = meaning.is_armed
            self._armed_ns = self._changed_ns = arrived_ns
        if meaning.is_failsafe:
            self._note_failsafe(arrived_ns)
        if meaning.is_stick_override:
            self._stick_override_ns = arrived_ns
        if meaning.is_stick_loss:
            self._stick_loss_ns = arrived_ns

    def _note_failsafe(self, arrived_ns: int) -> None:
        if not self._is_failsafe:
            self._is_failsafe, self._changed_ns = True, arrived_ns

    def _receive_rc(self, rc: RcChannels, arrived_ns: int) -> None:
        calibration, self._rc_sticks = self._params.calibration, None
        self._rc = arrived_ns, rc, calibration
        pwm_us = calibration.stick_channels_us(rc.channels_us) if calibration else None
        if calibration and pwm_us and all(pwm_us):
            self._rc_sticks = calibration.to_sticks(pwm_us)
        # Without a calibration, the sticks are by convention the first four channels.
        channels_us = rc.channels_us[:4] if pwm_us is None else pwm_us
        if not self.is_receiver_hidden and channels_us:
            radio = [value_us for value_us in rc.channels_us if value_us in RADIO_US]
            # Overrides that have ended may go on to look like a healthy receiver.
            has_more = len(radio) > len(channels_us) or not self._params.traits.keeps_sticks
            self._is_rc_plausible = has_more and all(us in RADIO_US for us in channels_us)
        if self.is_released and self.has_receiver:
            self._pilot_sticks = self._rc_sticks

    @property
    def has_receiver(self) -> bool | None:
        """True if a receiver was seen before our first override; None: unknown.

        A vehicle that has lost its receiver keeps showing the last sticks, but marks the receiver
        as unhealthy.
        """
        return self._is_rc_plausible if self._is_rc_healthy is not False else False

    def _system_bit(self, bit: int) -> bool | None:
        """Return the newest health by SYS_STATUS; None: not reported."""
        system = self._last(SystemStatus)
        return bool(system.healthy & bit) if system is not None and system.present & bit else None

    @property
    def is_ready_to_arm(self) -> bool | None:
        """True if the autopilot's arming checks have passed; None: not reported."""
        return self._system_bit(dialect.MAV_SYS_STATUS_PREARM_CHECK)

    def is_receiver_settled(self, now_ns: int) -> bool:
        """True if a receiver and its sticks would have been seen, or the wait for them is over."""
        is_read = self._rc is not None and self._rc[2] == self._params.calibration
        has_seen_radio = is_read and self._last(SystemStatus) is not None
        due_ns = self.receiver_due_ns
        return has_seen_radio or (due_ns is not None and now_ns >= due_ns)

    def is_velocity_usable(self, now_ns: int) -> bool:
        """False for a velocity that the firmware sends without a valid estimate."""
        flags = self._flags(now_ns)
        is_valid = flags is None or bool(flags & dialect.ESTIMATOR_VELOCITY_HORIZ)
        return is_valid or not self._profile.sends_invalid_estimates

    def amsl_m(self, now_ns: int) -> float | None:
        """Return the height above mean sea level; None without a fresh one."""
        altitude = self._last(Altitude, now_ns)
        return None if altitude is None else altitude.amsl_m

    def _flags(self, now_ns: int) -> int | None:
        estimator = self._last(EstimatorFlags, now_ns)
        return None if estimator is None else estimator.flags

    def status(self, now_ns: int) -> VehicleStatus | None:
        """Return the vehicle's status; None before its first heartbeat."""
        if self.heartbeat is None:
            return None
        if self._status is None or not 0 <= now_ns - self._status_ns < _STATUS_NS:
            has_receiver = self.has_receiver
            is_absent = has_receiver is None and not self._profile.has_rc_channels_always
            is_ignored = has_receiver and self._params.traits.ignores_receiver
            if (is_absent or is_ignored) and self.is_receiver_settled(now_ns):
                has_receiver = False
            self._status, self._status_ns = self._status_at(now_ns, has_receiver), now_ns
        return self._status

    def _status_at(self, now_ns: int, has_receiver: bool | None) -> VehicleStatus:
        rc_ns, rc, _ = self._rc or (None, RcChannels((), 0), None)
        is_shown = rc_ns is not None and now_ns - rc_ns <= GAP_NS
        is_valid = self._is_position_valid(now_ns)
        return VehicleStatus(
            mode=self._profile.modes.name(self._custom_mode),
            armed=self._is_armed,
            mode_arrived_ns=self._mode_ns,
            armed_arrived_ns=self._armed_ns,
            rc_sticks=self._rc_sticks if is_shown else None,
            rc_channels_us=rc.channels_us if is_shown else (),
            channels_arrived_ns=rc_ns,
            rc_arrived_ns=rc_ns,
            is_failsafe=self._is_failsafe,
            is_mode_chosen=self._is_mode_chosen,
            is_landed=self._is_landed(now_ns),
            has_receiver=has_receiver,
            is_receiver_sick=self._system_bit(dialect.MAV_SYS_STATUS_SENSOR_RC_RECEIVER) is False,
            pilot_sticks=self._pilot_sticks,
            position_ned_m=self._position_ned_m(now_ns, is_valid),
            is_position_valid=is_valid,
            battery_problem=self._battery_problem(now_ns),
            is_charge_known=self._is_charge_known(now_ns),
            stick_override_ns=self._stick_override_ns,
            stick_loss_ns=self._stick_loss_ns,
        )

    def _is_position_valid(self, now_ns: int) -> bool | None:
        flags = self._flags(now_ns)
        if flags is None:
            return None
        # Ignore the bit for a constant position: PX4 also sets it at rest on the ground with a
        # good position. Without a position neither autopilot sets these bits.
        return bool(flags & _HORIZONTAL_POSITION)

    def _position_ned_m(
        self, now_ns: int, is_valid: bool | None
    ) -> tuple[float, float, float] | None:
        """Return the position if valid: some firmware also sends one without an estimate."""
        is_trusted = is_valid is None and not self._profile.sends_invalid_estimates
        is_good = is_valid is True or is_trusted
        position = self._last(LocalVelocity, now_ns, POSITION_FRESH_NS) if is_good else None
        return None if position is None else position.position_ned_m

    def _is_landed(self, now_ns: int) -> bool | None:
        landed = self._last(LandedState, now_ns)
        if landed is None or landed.landed_state == dialect.MAV_LANDED_STATE_UNDEFINED:
            return None
        return bool(landed.landed_state == dialect.MAV_LANDED_STATE_ON_GROUND)

    def _battery_problem(self, now_ns: int) -> Reason | None:
        if (system := self._last(SystemStatus, now_ns)) is None:
            return None
        bit = dialect.MAV_SYS_STATUS_SENSOR_BATTERY
        if system.present & bit and not system.healthy & bit:
            return because(Code.BATTERY)
        if 0 <= system.battery_percent < self._min_battery_percent:
            percent, limit = system.battery_percent, self._min_battery_percent
            return because(Code.BATTERY_BELOW, percent=percent, limit=limit)
        return None

    def _is_charge_known(self, now_ns: int) -> bool:
        system = self._last(SystemStatus, now_ns)
        is_reported = system is not None and system.battery_percent >= 0
        return is_reported or self._min_battery_percent <= 0

    def _last(
        self, kind: type[_T], now_ns: int | None = None, most_ns: int = SLOW_FRESH_NS
    ) -> _T | None:
        """Return the newest message of a kind, unless it is too old at ``now_ns``."""
        arrived_ns, body = self._newest.get(kind, (0, None))
        is_old = now_ns is not None and now_ns - arrived_ns > most_ns
        return body if isinstance(body, kind) and not is_old else None
