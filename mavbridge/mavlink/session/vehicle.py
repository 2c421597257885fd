"""The session with one vehicle: its set-up, its state, and whether it can be flown.

A state machine without I/O. The link steps it at every tick, so connecting, reconnecting and a
rebooted vehicle are all handled alike, and the action loop never waits for any of them.
"""

from collections.abc import Callable, Iterator
from functools import cached_property

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import VehicleStatus
from mavbridge.mavlink.codec.calibration import Pwm, RcCalibration
from mavbridge.mavlink.codec.messages import (
    Attitude,
    AutopilotVersion,
    CommandAck,
    CommandRequest,
    Heartbeat,
    LocalVelocity,
    ParamValue,
    RcChannels,
    ReceivedMessage,
    Request,
    SpecificForce,
    StatusText,
)
from mavbridge.mavlink.session import params
from mavbridge.mavlink.session.discovery import VehicleIdentity
from mavbridge.mavlink.session.echo import EchoCheck
from mavbridge.mavlink.session.modes import ModeTable
from mavbridge.mavlink.session.streams import StreamRequester, message_id, telemetry_streams
from mavbridge.mavlink.session.telemetry import TelemetryCollector
from mavbridge.mavlink.settings import LinkSettings

RC_CHANNELS_HZ = 20.0
"""RC_CHANNELS for the echo check and the pilot's sticks; the check needs 10 Hz or more."""
HEARTBEAT_TIMEOUT_NS = 3 * NS_PER_S
"""Heartbeats come at 1 Hz: a vehicle that loses three in a row is lost."""
_VERSION_TIMEOUT_NS = 400 * NS_PER_MS
_VERSION_ATTEMPTS = 4
_REBOOT_STEP_MS = 1000
_REBOOT_STAMPS = 2
"""One old stamp may be a delayed datagram; two in a row are a clock that has restarted."""
_SWITCH_ON_US = 1800
"""ArduPilot's threshold of a high auxiliary switch."""


class VehicleSession:
    """One vehicle from its first heartbeat to its next reboot.

    Reads its version, then its parameters (if the output needs them), then requests its streams and
    keeps them coming. ``report`` shows a text to the user.

    Raises:
        PeerError: the vehicle cannot be flown with the configured output.
    """

    def __init__(
        self,
        identity: VehicleIdentity,
        config: LinkSettings,
        *,
        report: Callable[[str], None],
    ) -> None:
        self._source_system = config.source_system
        self._is_override = config.output == "rc-override"
        if self._is_override and identity.autopilot == "px4":
            raise PeerError(
                "PX4 cannot release an RC_CHANNELS_OVERRIDE: use --output manual-control"
            )
        if not self._is_override and identity.autopilot == "ardupilot":
            raise PeerError("ArduPilot cannot release a MANUAL_CONTROL: use --output rc-override")
        self.identity = identity
        self._report = report
        self.modes = ModeTable(autopilot=identity.autopilot, vehicle_type=identity.vehicle_type)
        self.telemetry = TelemetryCollector()
        self.echo = EchoCheck()
        self.calibration: RcCalibration | None = None
        self.version: str | None = None
        self._version_attempts = 0
        self._version_due_ns = 0
        self._params = params.ParamReader(params.FIRST_NAMES if self._is_override else ())
        self._is_reading_channels = False
        self._streams = StreamRequester(
            telemetry_streams(state_hz=config.state_hz, rc_hz=RC_CHANNELS_HZ)
        )
        self._has_advised = False
        self._status: VehicleStatus | None = None
        """None after a message that may have changed it."""
        self._heartbeat: tuple[int, Heartbeat] | None = None
        self._rc: tuple[int, RcChannels] | None = None
        self._boot_ms = 0
        self._old_stamps = 0

    @property
    def has_rebooted(self) -> bool:
        """Its clock has started again."""
        return self._old_stamps >= _REBOOT_STAMPS

    def receive(self, message: ReceivedMessage, arrived_ns: int) -> None:
        """Take one message from this vehicle."""
        self._streams.receive(message.name)
        match message.body:
            case Attitude() | LocalVelocity() | SpecificForce() as body:
                if isinstance(body, Attitude):
                    self._watch_boot(body.boot_ms)
                self.telemetry.receive(body, arrived_ns)
            case RcChannels() as body:
                self._status = None
                self._rc = (arrived_ns, body)
                if (pwm_us := self._stick_channels_us(body)) is not None:
                    self.echo.received(pwm_us, arrived_ns)
            case Heartbeat() as body:
                self._status = None
                self._heartbeat = (arrived_ns, body)
            case CommandAck() as body:
                self._streams.receive_ack(body)
            case ParamValue() as body:
                self._params.receive(body)
            case AutopilotVersion(version):
                self.version = version
            case StatusText(text):
                self._report(f"vehicle: {text}")
            case _:
                pass  # handled by the link, or not used

    def _watch_boot(self, boot_ms: int) -> None:
        if boot_ms + _REBOOT_STEP_MS < self._boot_ms:
            self._old_stamps += 1
        else:
            self._old_stamps, self._boot_ms = 0, boot_ms

    def _stick_channels_us(self, rc: RcChannels) -> Pwm | None:
        calibration = self.calibration
        if calibration is None or len(rc.channels_us) < 8:
            return None
        t, y, p, r = (rc.channels_us[channel.number - 1] for channel in calibration.channels)
        return t, y, p, r

    def step(self, now_ns: int) -> Iterator[Request]:
        """Requests that are due.

        Raises:
            PeerError: the vehicle cannot be flown with its present parameters.
        """
        is_version_open = self.version is None and self._version_attempts < _VERSION_ATTEMPTS
        if is_version_open and now_ns >= self._version_due_ns:
            self._version_due_ns = now_ns + _VERSION_TIMEOUT_NS
            self._version_attempts += 1
            number = float(message_id("AUTOPILOT_VERSION"))
            yield CommandRequest(dialect.MAV_CMD_REQUEST_MESSAGE, (number,))
        # Streams come after parameters: a vehicle slows its streams down while it sends those.
        if self._is_override and self.calibration is None:
            yield from self._params.step(now_ns)
            self._advance_params()
        elif (request := self._streams.step(now_ns)) is not None:
            yield request
        if not self._has_advised and self._unfinished() is None:
            self._has_advised = True
            for advice in params.override_advice(self._params.values):
                self._report(advice)

    def _advance_params(self) -> None:
        if not self._params.is_done:
            return
        if self._is_reading_channels:
            self.calibration = params.calibration(self._params.values)
        else:
            self._is_reading_channels = True
            self._params.request(params.calibration_names(self._params.values))

    def _unfinished(self) -> str | None:
        """The step of the set-up that is not finished, or None."""
        if self._is_override and self.calibration is None:
            return "reading the vehicle's radio calibration"
        if not self._streams.is_settled and self._streams.renewals == 0:
            return "requesting telemetry from the vehicle"
        return None

    def status(self) -> VehicleStatus | None:
        """The vehicle's own report; None before its first heartbeat."""
        if self._status is None and self._heartbeat is not None:
            heartbeat = self._heartbeat[1]
            rc_ns, rc = self._rc or (None, RcChannels(()))
            pwm_us, rc_sticks = self._stick_channels_us(rc), None
            if self.calibration and pwm_us and all(pwm_us):
                rc_sticks = self.calibration.to_sticks(pwm_us)
            self._status = VehicleStatus(
                mode=self.modes.name(heartbeat.custom_mode),
                armed=bool(heartbeat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED),
                rc_sticks=rc_sticks,
                rc_channels_us=rc.channels_us,
                rc_arrived_ns=rc_ns,
            )
        return self._status

    def problem(self, now_ns: int) -> str | None:
        """The reason why it cannot be flown now, or None."""
        if self._heartbeat is None:
            return "waiting for the vehicle's heartbeat"
        if now_ns - self._heartbeat[0] > HEARTBEAT_TIMEOUT_NS:
            return "the vehicle's heartbeat is lost"
        if (unfinished := self._unfinished()) is not None or not self._is_override:
            return unfinished
        obstacles, switch = self._override_check
        if obstacles:
            return f"the vehicle would ignore our sticks: {obstacles}"
        if switch is not None:
            channels_us = self._rc[1].channels_us if self._rc else ()
            if len(channels_us) < switch or channels_us[switch - 1] < _SWITCH_ON_US:
                return f"the override switch (RC{switch}) is off: switch it on to fly"
        return None

    @cached_property
    def _override_check(self) -> tuple[str, int | None]:
        """Obstacles to overriding (empty = none), and the channel of the override switch."""
        values = self._params.values
        obstacles = params.override_obstacles(values, self._source_system)
        return "; ".join(obstacles), params.override_switch(values)

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
