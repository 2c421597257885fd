"""The vehicle as the action loop sees it. One thread owns socket and codec."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, period_ns
from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import (
    Decision,
    LinkSnapshot,
    LinkStats,
    Release,
    Sticks,
    Telemetry,
)
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import CommandAck, CommandRequest, Heartbeat, Timesync
from mavbridge.mavlink.codec.packets import Codec, manual_control_sticks, pwm_of
from mavbridge.mavlink.session.discovery import VehicleDiscovery, VehicleIdentity
from mavbridge.mavlink.session.stats import LinkCounters
from mavbridge.mavlink.session.timesync import TimesyncFilter
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.mavlink.settings import LinkSettings
from mavbridge.mavlink.transport.connection import Connection, PacketLog
from mavbridge.mavlink.transport.sockets import Transport

SOURCE_COMPONENT = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
RELEASE_REPEATS = 10
RELEASE_SPACING_NS = 50 * NS_PER_MS
"""A release is sent ten times over half a second, since any one packet may be lost."""
_COMMAND_SPACING_NS = NS_PER_S
_HEARTBEAT_HZ = 1.0
"""MAVLink heartbeat protocol; autopilots time a peer out after several seconds."""
_DOWN = "the connection to the vehicle is lost: reconnecting"


class MavlinkLink:
    """Implements ``ports.Link`` over a transport.

    Raises from ``service``:
        PeerError: no vehicle within the timeout, two vehicles, or one that cannot be flown.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        config: LinkSettings,
        *,
        packet_log: PacketLog | None = None,
    ) -> None:
        self._clock = clock
        self._config = config
        self._codec = Codec(source_system=config.source_system, source_component=SOURCE_COMPONENT)
        self._connection = Connection(transport, self._codec, clock, packet_log)
        self._discovery = VehicleDiscovery(target_system=config.target_system)
        self._counters = LinkCounters()
        self._timesync = TimesyncFilter()
        self._started_ns = clock.now_ns()
        self._heartbeat_due_ns = self._started_ns
        self._vehicle: VehicleSession | None = None
        self._calibration: RcCalibration | None = None
        """Calibration of the last override that was sent: a release needs it even if the vehicle
        has rebooted since."""
        self._was_confirmed = False
        self._is_drained = False
        """``wait_for_attitude`` has just received everything."""
        self._release_due_ns = 0
        self._releases_left = 0
        self._requested_ns: dict[int, int] = {}

    # --- receiving

    def poll(self) -> LinkSnapshot:
        """Receive everything that has arrived; never blocks. All other work is in ``service``."""
        if not self._is_drained:
            self._receive_all()
        self._is_drained = False
        if self._vehicle is not None and self._vehicle.has_rebooted:
            self._report("the vehicle has rebooted: starting over")
            self._adopt(self._vehicle.identity)
        now_ns, texts = self._clock.now_ns(), tuple(self._connection.texts)
        self._connection.texts.clear()
        is_down, vehicle = self._connection.is_down, self._vehicle
        if vehicle is None:
            problem = _DOWN if is_down else "waiting for the vehicle's heartbeat"
            return LinkSnapshot(telemetry=Telemetry(), status=None, problem=problem, texts=texts)
        overruled = vehicle.overruled(now_ns)
        return LinkSnapshot(
            telemetry=vehicle.telemetry.snapshot(),
            status=vehicle.status(),
            problem=(_DOWN if is_down else vehicle.problem(now_ns)) or overruled,
            is_overruled=overruled is not None,
            echo_confirmed=vehicle.echo_confirmed,
            texts=texts,
        )

    def wait_for_attitude(self, *, newer_than_ns: int, until_ns: int) -> int:
        """Receive until an attitude newer than ``newer_than_ns`` has come, or until the deadline.

        Returns the arrival of the newest attitude, 0 before the first.
        """
        while self._clock.now_ns() < until_ns:
            self._receive_all()
            if self._attitude_ns() > newer_than_ns:
                self._is_drained = True
                break
            self._connection.wait(until_ns)
        return self._attitude_ns()

    def _attitude_ns(self) -> int:
        return 0 if self._vehicle is None else self._vehicle.telemetry.attitude_ns

    def _receive_all(self) -> None:
        vehicle = self._vehicle
        for message, arrived_ns, sender in self._connection.receive():
            if isinstance(message.body, Heartbeat):
                self._discovery.receive(message.source, message.body, sender, arrived_ns)
            if vehicle is None or message.source != vehicle.identity.source:
                continue
            if sender != vehicle.identity.address:
                continue
            self._counters.receive(message.name, message.sequence, arrived_ns)
            match message.body:
                case Timesync() as reply:
                    self._timesync.receive(reply, arrived_ns)
                case CommandAck() as ack if ack.target not in ((0, 0), self._codec.source):
                    continue  # an answer to another station
                case CommandAck() as ack:
                    self._report_refusal(ack)
            vehicle.receive(message, arrived_ns)

    def _report_refusal(self, ack: CommandAck) -> None:
        if ack.command not in self._requested_ns or ack.result == dialect.MAV_RESULT_ACCEPTED:
            return
        command = dialect.enums["MAV_CMD"][ack.command].name.removeprefix("MAV_CMD_")
        result = dialect.enums["MAV_RESULT"].get(ack.result)
        reason = result.name.removeprefix("MAV_RESULT_") if result else ack.result
        self._report(f"the vehicle answered {command} with {reason}")

    def stats(self) -> LinkStats:
        """Counters for the report."""
        has_echo = self._config.output == "rc-override"
        is_confirmed = self._vehicle is not None and self._vehicle.echo.confirmed
        return self._counters.stats(
            self._timesync,
            echo_confirmed=(self._was_confirmed or is_confirmed) if has_echo else None,
            unusable_packets=self._codec.bad_data_count,
        )

    @property
    def autopilot(self) -> str:
        """Autopilot and version, for the report."""
        if self._vehicle is None:
            return "none"
        return f"{self._vehicle.identity.autopilot} {self._vehicle.version or ''}".strip()

    # --- finding and keeping the vehicle

    def service(self) -> None:
        """Find or follow the vehicle and send due requests; called after the sticks are sent."""
        now_ns = self._clock.now_ns()
        if self._vehicle is None:
            self._find_vehicle(now_ns)
        elif (moved := self._discovery.moved(self._vehicle.identity, now_ns)) is not None:
            self._report(f"the vehicle now sends from {moved.address}: starting over")
            self._adopt(moved)
        if now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = now_ns + period_ns(_HEARTBEAT_HZ)
            self._connection.send(self._codec.encode_heartbeat())
        if (vehicle := self._vehicle) is None:
            return
        for request in vehicle.step(now_ns):
            self._connection.send(self._codec.encode_request(vehicle.identity.source, request))
        if (ts1 := self._timesync.request(now_ns)) is not None:
            self._connection.send(self._codec.encode_timesync(ts1))

    def _find_vehicle(self, now_ns: int) -> None:
        if (identity := self._discovery.choose(now_ns)) is not None:
            self._adopt(identity)
            return
        timeout_s, waited_ns = self._config.connect_timeout_s, now_ns - self._started_ns
        if not self._discovery.is_settling and waited_ns > timeout_s * NS_PER_S:
            waited = f"no vehicle on {self._config.connect} after {timeout_s:g} s"
            raise PeerError(f"{waited}: {self._discovery.describe()}")

    def _adopt(self, identity: VehicleIdentity) -> None:
        """Start a new session: at first sight, after a reboot and after a change of address."""
        self._vehicle = VehicleSession(identity, self._config, report=self._report)
        self._counters.new_sequence()
        self._connection.peer = identity.address

    def _report(self, text: str) -> None:
        self._connection.texts.append(text)

    def set_mode(self, mode: str) -> None:
        """Request a flight mode, at most once a second."""
        if self._vehicle is not None:
            flags = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            self._command(dialect.MAV_CMD_DO_SET_MODE, flags, self._vehicle.modes.number(mode))

    def arm(self) -> None:
        """Request arming, at most once a second."""
        self._command(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def _command(self, command: int, *values: float) -> None:
        now_ns, last_ns = self._clock.now_ns(), self._requested_ns.get(command)
        is_early = last_ns is not None and now_ns - last_ns < _COMMAND_SPACING_NS
        if self._vehicle is None or self._config.readonly or is_early:
            return
        self._requested_ns[command] = now_ns
        request = CommandRequest(command, values)
        self._connection.send(self._codec.encode_request(self._vehicle.identity.source, request))

    # --- sticks

    def send(self, decision: Decision) -> Sticks | None:
        """Send sticks or a release; returns the sticks that were really sent, or None."""
        if self._config.readonly or self._vehicle is None:
            return None
        if isinstance(decision, Release):
            self._send_release()
            return None
        if self._config.output == "rc-override":
            return self._send_override(decision.sticks, self._vehicle)
        system = self._vehicle.identity.source.system
        if not self._connection.send(self._codec.encode_manual_control(system, decision.sticks)):
            return None
        self._counters.sent += 1
        return manual_control_sticks(decision.sticks)

    def _send_override(self, sticks: Sticks, vehicle: VehicleSession) -> Sticks | None:
        calibration = vehicle.calibration
        if calibration is None:
            return None
        pwm_us = vehicle.echo.with_nudge(pwm_of(sticks, calibration))
        # Before the send: an override that may have left must be released.
        self._calibration, self._releases_left = calibration, RELEASE_REPEATS
        data = self._codec.encode_override(vehicle.identity.source, pwm_us, calibration)
        if not self._connection.send(data):
            return None
        vehicle.echo.sent(pwm_us, self._clock.now_ns())
        self._counters.sent += 1
        return calibration.to_sticks(pwm_us)

    def _send_release(self, *, is_forced: bool = False) -> None:
        """Send a release if one is due: ten of them, then nothing, so that others may override."""
        now_ns, vehicle = self._clock.now_ns(), self._vehicle
        if vehicle is None or self._calibration is None or not self._releases_left:
            return
        self._was_confirmed |= vehicle.echo.confirmed
        vehicle.echo.released()
        if now_ns < self._release_due_ns and not is_forced:
            return
        self._release_due_ns = now_ns + RELEASE_SPACING_NS
        data = self._codec.encode_release(vehicle.identity.source, self._calibration)
        if self._connection.send(data, is_forced=is_forced):
            self._releases_left -= 1

    def hand_back(self) -> None:
        """Send the remaining releases at the end of a flight; takes up to half a second."""
        if self._config.readonly:
            return
        for _ in range(self._releases_left):
            self._clock.sleep_until_ns(self._release_due_ns)
            self._send_release()

    def force_release(self) -> None:
        """From any thread: block all sends and release the sticks now.

        For when the thread that owns the link hangs; if it recovers, its sticks are dropped.
        """
        self._connection.block_sends()
        for _ in range(self._releases_left):
            self._send_release(is_forced=True)
            self._clock.sleep_until_ns(self._clock.now_ns() + RELEASE_SPACING_NS)

    def close(self) -> None:
        """Free the socket or port."""
        self._connection.close()
