"""What is known of the vehicle that was chosen, and whether it can be flown."""

from collections.abc import Mapping
from dataclasses import dataclass

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
from mavbridge.mavlink.session.echo import EchoCheck
from mavbridge.mavlink.session.handshake import Handshake
from mavbridge.mavlink.session.modes import ModeTable
from mavbridge.mavlink.session.roster import Peer
from mavbridge.mavlink.session.telemetry import TelemetryJoiner

HEARTBEAT_TIMEOUT_NS = 3 * NS_PER_S
"""Beats come at 1 Hz: three lost in a row are a lost vehicle."""
_REBOOT_STEP_MS = 1000
_REBOOT_STAMPS = 2
"""One old stamp may be a datagram that took a detour; two in a row are a clock that restarted."""
_SWITCH_ON_US = 1800
"""ArduPilot's threshold of a high auxiliary switch."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Override:
    """What the parameters say of overriding this vehicle."""

    obstacles: str
    """Why it would not obey us; empty where nothing speaks against it."""
    switch_channel: int | None

    @classmethod
    def read(cls, values: Mapping[str, float], source_system: int) -> "_Override":
        return cls(
            obstacles="; ".join(params.override_obstacles(values, source_system)),
            switch_channel=params.override_switch(values),
        )


class Vehicle:
    """One vehicle from its first heartbeat to its next reboot.

    Raises:
        PeerError: it cannot be flown with the output that was asked for.
    """

    def __init__(self, peer: Peer, config: LinkConfig, *, state_hz: float) -> None:
        self._config = config
        self._is_override = config.output == "rc-override"
        if self._is_override and peer.autopilot == "px4":
            raise PeerError(
                "PX4 takes RC_CHANNELS_OVERRIDE literally and has no release: "
                "use --output manual-control"
            )
        if not self._is_override and peer.autopilot == "ardupilot":
            raise PeerError(
                "ArduPilot holds MANUAL_CONTROL like an override, and it cannot be released: "
                "use --output rc-override"
            )
        self.peer = peer
        self.modes = ModeTable(autopilot=peer.autopilot, vehicle_type=peer.vehicle_type)
        self.telemetry = TelemetryJoiner()
        self.echo = EchoCheck()
        self.handshake = Handshake(
            needs_calibration=self._is_override,
            wanted=streams.groups(state_hz=state_hz, rc_hz=RC_CHANNELS_HZ),
        )
        self._status: VehicleStatus | None = None
        """As last told; None after a message that may have changed it."""
        self._beat: tuple[int, Heartbeat] | None = None
        self._rc: tuple[int, RcChannels] | None = None
        self._override: _Override | None = None
        self._boot_ms = 0
        self._old_stamps = 0

    @property
    def calibration(self) -> RcCalibration | None:
        """Its radio calibration, once read."""
        return self.handshake.calibration

    @property
    def has_rebooted(self) -> bool:
        """Its clock has started again."""
        return self._old_stamps >= _REBOOT_STAMPS

    def receive(self, body: Body, arrived_ns: int) -> None:
        """Take one message of this vehicle."""
        match body:
            case Attitude():
                self._watch_boot(body.boot_ms)
                self.telemetry.attitude(body, arrived_ns)
            case LocalVelocity():
                self.telemetry.velocity(body, arrived_ns)
            case SpecificForce():
                self.telemetry.force(body, arrived_ns)
            case RcChannels():
                self._status = None
                self._rc = (arrived_ns, body)
                if (pwm_us := self._stick_channels_us(body)) is not None:
                    self.echo.received(pwm_us, arrived_ns)
            case Heartbeat():
                self._status = None
                self._beat = (arrived_ns, body)
            case CommandAck():
                self.handshake.receive_ack(body)
            case ParamValue():
                self.handshake.receive_param(body)
            case AutopilotVersion():
                self.handshake.receive_version(body)
            case _:
                pass  # addressed to the link as a whole

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
        """What it says of itself; None before its first heartbeat."""
        if self._status is None and self._beat is not None:
            self._status = self._tell_status(*self._beat)
        return self._status

    def _tell_status(self, beat_ns: int, beat: Heartbeat) -> VehicleStatus:
        rc_sticks = None
        if self._rc and self.calibration:
            pwm_us = self._stick_channels_us(self._rc[1])
            if pwm_us is not None and all(pwm_us):
                rc_sticks = self.calibration.to_sticks(pwm_us)
        return VehicleStatus(
            system_id=self.peer.source.system,
            autopilot=self.peer.autopilot,
            mode=self.modes.name(beat.custom_mode),
            armed=bool(beat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED),
            heartbeat_ns=beat_ns,
            rc_sticks=rc_sticks,
            rc_channels_us=self._rc[1].channels_us if self._rc else (),
            rc_arrived_ns=self._rc[0] if self._rc else None,
        )

    def problem(self) -> str | None:
        """Why it cannot be flown now, before any stick is sent; None if it can."""
        if (problem := self.handshake.problem) is not None or not self._is_override:
            return problem
        if self._override is None:  # once: the parameters are all read by now
            self._override = _Override.read(self.handshake.values, self._config.source_system)
        if self._override.obstacles:
            return f"the vehicle would not act on our sticks: {self._override.obstacles}"
        if (channel := self._override.switch_channel) is not None:
            values = self._rc[1].channels_us if self._rc else ()
            if len(values) < channel or values[channel - 1] < _SWITCH_ON_US:
                return f"the override switch (RC{channel}) is off"
        return None

    @property
    def has_beaten(self) -> bool:
        """Its heartbeat was heard, since it was chosen."""
        return self._beat is not None

    def is_lost(self, now_ns: int) -> bool:
        """It has stopped beating."""
        return self._beat is not None and now_ns - self._beat[0] > HEARTBEAT_TIMEOUT_NS

    def overruled(self, now_ns: int) -> str | None:
        """Why it does not act on the sticks that we send, or None."""
        if not self.echo.failed(now_ns):
            return None
        if self._rc is None or now_ns - self._rc[0] > NS_PER_S:
            reason = "no RC_CHANNELS arrives to check against"
        else:
            reason = "another station may be overriding, or the receiver has priority"
        return f"the vehicle does not act on our sticks: {reason}"

    @property
    def echo_confirmed(self) -> bool:
        """It was seen to act on our sticks, or its output has no echo to check."""
        return not self._is_override or self.echo.confirmed
