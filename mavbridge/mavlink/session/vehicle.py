"""The session with one vehicle: its state, and whether it can be flown."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.config.flight import LinkConfig
from mavbridge.config.rates import RC_CHANNELS_HZ
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.records import VehicleStatus
from mavbridge.mavlink.codec.calibration import Pwm, RcCalibration
from mavbridge.mavlink.codec.messages import (
    Attitude,
    AutopilotVersion,
    Body,
    CommandAck,
    Heartbeat,
    LocalVelocity,
    ParamValue,
    RcChannels,
    SpecificForce,
)
from mavbridge.mavlink.session import params, streams
from mavbridge.mavlink.session.discovery import VehicleIdentity
from mavbridge.mavlink.session.echo import EchoCheck
from mavbridge.mavlink.session.handshake import Handshake
from mavbridge.mavlink.session.modes import ModeTable
from mavbridge.mavlink.session.telemetry import TelemetryCollector

HEARTBEAT_TIMEOUT_NS = 3 * NS_PER_S
"""Heartbeats come at 1 Hz: a vehicle that loses three in a row is lost."""
_REBOOT_STEP_MS = 1000
_REBOOT_STAMPS = 2
"""One old stamp may be a delayed datagram; two in a row are a clock that has restarted."""
_SWITCH_ON_US = 1800
"""ArduPilot's threshold of a high auxiliary switch."""


class VehicleSession:
    """One vehicle from its first heartbeat to its next reboot.

    Raises:
        PeerError: the vehicle cannot be flown with the configured output.
    """

    def __init__(self, identity: VehicleIdentity, config: LinkConfig, *, state_hz: float) -> None:
        self._source_system = config.source_system
        self._is_override = config.output == "rc-override"
        if self._is_override and identity.autopilot == "px4":
            raise PeerError(
                "PX4 cannot release an RC_CHANNELS_OVERRIDE: use --output manual-control"
            )
        if not self._is_override and identity.autopilot == "ardupilot":
            raise PeerError("ArduPilot cannot release a MANUAL_CONTROL: use --output rc-override")
        self.identity = identity
        self.modes = ModeTable(autopilot=identity.autopilot, vehicle_type=identity.vehicle_type)
        self.telemetry = TelemetryCollector()
        self.echo = EchoCheck()
        self.handshake = Handshake(
            needs_calibration=self._is_override,
            wanted=streams.telemetry_streams(state_hz=state_hz, rc_hz=RC_CHANNELS_HZ),
        )
        self._status: VehicleStatus | None = None
        """None after a message that may have changed it."""
        self._heartbeat: tuple[int, Heartbeat] | None = None
        self._rc: tuple[int, RcChannels] | None = None
        self._override: tuple[str, int | None] | None = None
        """Obstacles to overriding (empty = none) and the channel of the override switch."""
        self._boot_ms = 0
        self._old_stamps = 0

    @property
    def calibration(self) -> RcCalibration | None:
        """Its radio calibration, once it is read."""
        return self.handshake.calibration

    @property
    def has_rebooted(self) -> bool:
        """Its clock has started again."""
        return self._old_stamps >= _REBOOT_STAMPS

    def receive(self, body: Body, arrived_ns: int) -> None:
        """Take one message from this vehicle."""
        match body:
            case Attitude() | LocalVelocity() | SpecificForce():
                if isinstance(body, Attitude):
                    self._watch_boot(body.boot_ms)
                self.telemetry.receive(body, arrived_ns)
            case RcChannels():
                self._status = None
                self._rc = (arrived_ns, body)
                if (pwm_us := self._stick_channels_us(body)) is not None:
                    self.echo.received(pwm_us, arrived_ns)
            case Heartbeat():
                self._status = None
                self._heartbeat = (arrived_ns, body)
            case CommandAck() | ParamValue() | AutopilotVersion():
                self.handshake.receive(body)
            case _:
                pass  # handled by the link

    def _watch_boot(self, boot_ms: int) -> None:
        if boot_ms + _REBOOT_STEP_MS < self._boot_ms:
            self._old_stamps += 1
        else:
            self._old_stamps = 0
            self._boot_ms = boot_ms

    def _stick_channels_us(self, rc: RcChannels) -> Pwm | None:
        calibration = self.calibration
        if calibration is None or len(rc.channels_us) < 8:
            return None
        t, y, p, r = (rc.channels_us[channel.number - 1] for channel in calibration.channels)
        return t, y, p, r

    def status(self) -> VehicleStatus | None:
        """The vehicle's own report; None before its first heartbeat."""
        if self._status is None and self._heartbeat is not None:
            self._status = self._make_status(*self._heartbeat)
        return self._status

    def _make_status(self, heartbeat_ns: int, heartbeat: Heartbeat) -> VehicleStatus:
        rc_sticks = None
        if self._rc and self.calibration:
            pwm_us = self._stick_channels_us(self._rc[1])
            if pwm_us is not None and all(pwm_us):
                rc_sticks = self.calibration.to_sticks(pwm_us)
        return VehicleStatus(
            system_id=self.identity.source.system,
            autopilot=self.identity.autopilot,
            mode=self.modes.name(heartbeat.custom_mode),
            armed=bool(heartbeat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED),
            heartbeat_ns=heartbeat_ns,
            rc_sticks=rc_sticks,
            rc_channels_us=self._rc[1].channels_us if self._rc else (),
            rc_arrived_ns=self._rc[0] if self._rc else None,
        )

    def problem(self, now_ns: int) -> str | None:
        """The reason why it cannot be flown now, or None."""
        if self._heartbeat is None:
            return "waiting for the vehicle's heartbeat"
        if now_ns - self._heartbeat[0] > HEARTBEAT_TIMEOUT_NS:
            return "the vehicle's heartbeat is lost"
        if (problem := self.handshake.problem) is not None or not self._is_override:
            return problem
        if self._override is None:  # once: the parameters are all read by now
            values = self.handshake.values
            obstacles = "; ".join(params.override_obstacles(values, self._source_system))
            self._override = obstacles, params.override_switch(values)
        obstacles, switch = self._override
        if obstacles:
            return f"the vehicle would ignore our sticks: {obstacles}"
        if switch is not None:
            channels_us = self._rc[1].channels_us if self._rc else ()
            if len(channels_us) < switch or channels_us[switch - 1] < _SWITCH_ON_US:
                return (
                    f"the override switch (RC{switch}) is off: switch it on to let the policy fly"
                )
        return None

    def overruled(self, now_ns: int) -> str | None:
        """The likely reason why it ignores the sticks that we send, or None."""
        if not self.echo.failed(now_ns):
            return None
        if self._rc is None or now_ns - self._rc[0] > NS_PER_S:
            reason = "no RC_CHANNELS arrive to check against"
        else:
            reason = "another station may be overriding them, or the receiver has priority"
        return f"the vehicle ignores our sticks: {reason}"

    @property
    def echo_confirmed(self) -> bool:
        """It was seen to act on our sticks, or its output has no echo to check."""
        return not self._is_override or self.echo.confirmed
