"""The vehicle as the gate sees it. One thread owns socket and codec."""

from collections.abc import Callable, Mapping

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, period_ns
from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import (
    ActionMeaning,
    Decision,
    ForwardedPacket,
    LinkSnapshot,
    LinkStats,
    Output,
    Release,
    Sticks,
    Telemetry,
)
from mavbridge.mavlink.codec.messages import (
    Attitude,
    CommandAck,
    CommandRequest,
    Heartbeat,
    LocalVelocity,
    ReceivedMessage,
    SpecificForce,
    Timesync,
)
from mavbridge.mavlink.codec.packets import Codec, manual_control_sticks, pwm_of
from mavbridge.mavlink.session.commands import ModeAndArm
from mavbridge.mavlink.session.discovery import VehicleDiscovery, VehicleIdentity
from mavbridge.mavlink.session.release import ReleasePlan
from mavbridge.mavlink.session.stats import LinkCounters
from mavbridge.mavlink.session.telemetry import TelemetryCollector
from mavbridge.mavlink.session.timesync import TimesyncFilter
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.mavlink.settings import LinkSettings
from mavbridge.mavlink.transport.connection import Connection, PacketLog
from mavbridge.mavlink.transport.sockets import Address, Transport

SOURCE_COMPONENT = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
_HEARTBEAT_HZ = 1.0
"""MAVLink heartbeat protocol; autopilots time a peer out after several seconds."""
_SILENT_NS = 500 * NS_PER_MS
"""Silence after which a vehicle that is heard elsewhere is taken to have moved there."""
_OTHERS = 16
_DOWN = "the connection to the vehicle is lost: reconnecting"


class MavlinkLink:
    """The session with one vehicle over a transport; used by one thread, and never waits.

    ``forward`` gets every packet of the chosen vehicle, in order, while ``poll`` runs; it must
    neither wait nor raise. Problems of the transport are never raised once it has been opened:
    they stand in the snapshot, and it is opened again once a second.

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
        forward: Callable[[ForwardedPacket], None] | None = None,
    ) -> None:
        self._clock = clock
        self._config = config
        self._forward = forward
        self._codec = Codec(source_system=config.source_system, source_component=SOURCE_COMPONENT)
        self._connection = Connection(transport, self._codec, clock, packet_log)
        self._discovery = VehicleDiscovery(target_system=config.target_system)
        self._counters = LinkCounters()
        self._timesync = TimesyncFilter()
        self._telemetry = TelemetryCollector()
        self._commands = ModeAndArm()
        self._release = ReleasePlan()
        self.is_engaged = False
        """We hold the vehicle's sticks, or are giving them back: no other address is followed."""
        self._started_ns = clock.now_ns()
        self._heartbeat_due_ns = self._started_ns
        self._vehicle: VehicleSession | None = None
        self._was_confirmed = False
        self._interruption: str | None = None
        self._interruptions = 0
        self._moved_ns: int | None = None
        """When an engaged vehicle was last found to have moved."""
        self._others: set[Address | None] = set()
        """Other senders with the vehicle's system id that were reported."""

    def fileno(self) -> int | None:
        """Descriptor for ``select`` to wake up on arrivals; None while the transport is closed."""
        return self._connection.fileno()

    # --- receiving

    def poll(self) -> LinkSnapshot:
        """Receive everything that has arrived; never blocks. All other work is in ``service``."""
        self._receive_all()
        if self._vehicle is not None and self._vehicle.has_rebooted:
            self._interrupt("the vehicle has rebooted: its session starts over")
            self._adopt(self._vehicle.identity)
        now_ns, texts = self._clock.now_ns(), tuple(self._connection.texts)
        self._connection.texts.clear()
        is_down, vehicle = self._connection.is_down, self._vehicle
        if vehicle is None:
            problem = _DOWN if is_down else "waiting for the vehicle's heartbeat"
            return LinkSnapshot(telemetry=Telemetry(), status=None, problem=problem, texts=texts)
        overruled = vehicle.overruled(now_ns)
        return LinkSnapshot(
            telemetry=self._telemetry.snapshot(),
            status=vehicle.status(now_ns),
            problem=(_DOWN if is_down else vehicle.problem(now_ns))
            or overruled
            or vehicle.unheard(now_ns),
            is_overruled=overruled is not None,
            is_switched_off=vehicle.is_switched_off,
            echo_confirmed=vehicle.echo_confirmed,
            is_released=vehicle.is_released,
            shows_last=vehicle.echo.shows_last,
            interruption=self._interruption,
            modes=vehicle.condition.modes.roles,
            refused_mode=self._commands.refused_mode,
            texts=texts,
        )

    def _receive_all(self) -> None:
        vehicle = self._vehicle
        for message, arrived_ns, sender in self._connection.receive():
            if isinstance(message.body, Heartbeat):
                self._discovery.receive(message.source, message.body, sender, arrived_ns)
            if vehicle is None or message.source != vehicle.identity.source:
                continue
            if sender != vehicle.identity.address:
                if isinstance(message.body, Heartbeat):
                    self._notice_other(vehicle.identity, sender, arrived_ns)
                continue
            self._receive(vehicle, message, arrived_ns)

    def _receive(self, vehicle: VehicleSession, message: ReceivedMessage, arrived_ns: int) -> None:
        """Take one message of the chosen vehicle."""
        self._counters.receive(message.name, message.sequence, arrived_ns)
        happened_ns, is_for_us = arrived_ns, True
        match message.body:
            case LocalVelocity() if not vehicle.condition.is_velocity_usable(arrived_ns):
                vehicle.receive(message, arrived_ns)
                return  # the estimator says that it has none: nobody takes it for one
            case Attitude() | LocalVelocity() | SpecificForce() as body:
                happened_ns = self._timesync.happened_ns(body.boot_us, arrived_ns)
                self._telemetry.receive(body, arrived_ns, happened_ns)
            case Timesync() as reply:
                self._timesync.receive(reply, arrived_ns)
            case CommandAck() as ack:
                is_for_us = ack.target in ((0, 0), self._codec.source)
                if is_for_us and (refusal := self._commands.receive(ack)) is not None:
                    self._report(refusal)
        if is_for_us:
            before = vehicle.param_interruption
            vehicle.receive(message, arrived_ns)
            if (changed := vehicle.param_interruption) is not None and changed != before:
                self._interrupt(changed)
        if self._forward is not None:
            self._forward(ForwardedPacket(arrived_ns, happened_ns, message.packet))

    def _notice_other(self, identity: VehicleIdentity, sender: Address | None, now_ns: int) -> None:
        """Another address uses the vehicle's system id: its packets are ignored while we fly."""
        system, ours = identity.source.system, _name(identity.address)
        advice = "give it another system id, or keep it off this port"
        if not self.is_engaged or now_ns - self._counters.heard_ns < _SILENT_NS:
            if sender not in self._others and len(self._others) < _OTHERS:
                self._others.add(sender)
                text = f"system {system} is also heard from {_name(sender)}, which is ignored"
                self._report(f"{text}: the vehicle is at {ours}; {advice}")
        elif self._moved_ns is None or now_ns - self._moved_ns > NS_PER_S:
            self._moved_ns = now_ns
            self._interrupt(
                f"the vehicle at {ours} is silent, and system {system} is now heard from "
                f"{_name(sender)}, which is not followed in flight: if it is another vehicle, "
                f"{advice}; if this one has moved, engage again"
            )

    def _interrupt(self, text: str) -> None:
        """Note why every engagement so far is over; no two such texts are the same."""
        self._interruptions += 1
        count = f" (interruption {self._interruptions})" if self._interruptions > 1 else ""
        self._interruption = text + count
        self._report(self._interruption)

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

    @property
    def is_release_owed(self) -> bool:
        """A release could not be sent: ``service`` sends it before everything else."""
        return self._release.is_owed

    # --- the vehicle's parameters

    @property
    def known_params(self) -> Mapping[str, float]:
        """The vehicle's parameters that matter for a flight, by name, for the report."""
        return {} if self._vehicle is None else self._vehicle.known_params

    def begin_restore(self) -> None:
        """Let ``service`` put back what was set for the flight; may be called at every tick."""
        if self._vehicle is not None:
            self._vehicle.begin_restore()

    @property
    def is_restored(self) -> bool:
        """Nothing is left to put back, or no more can be done; true some 3 s later at the latest,
        if the vehicle is still heard."""
        return self._vehicle is None or self._vehicle.is_restored

    # --- finding and keeping the vehicle

    def service(self) -> None:
        """Find or follow the vehicle and send due requests; called after the sticks are sent."""
        now_ns = self._clock.now_ns()
        if self._vehicle is None:
            self._find_vehicle(now_ns)
        elif not self.is_engaged:
            self._follow_vehicle(self._vehicle.identity, now_ns)
        if self._release.is_owed and not self._try_release():
            return
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

    def _follow_vehicle(self, identity: VehicleIdentity, now_ns: int) -> None:
        if (moved := self._discovery.moved(identity, now_ns)) is not None:
            addresses = f"{_name(moved.address)} instead of {_name(identity.address)}"
            self._interrupt(f"the vehicle now sends from {addresses}: its session starts over")
            self._adopt(moved)

    def _adopt(self, identity: VehicleIdentity) -> None:
        """Start a new session: at first sight, after a reboot and after a change of address."""
        self._vehicle = VehicleSession(identity, self._config, report=self._report)
        self._telemetry = TelemetryCollector()
        self._timesync.restart()
        self._commands = ModeAndArm()
        self._counters.new_sequence()
        self._others.clear()
        self._connection.peer = identity.address

    def _report(self, text: str) -> None:
        self._connection.texts.append(text)

    def set_mode(self, mode: str) -> None:
        """Request a flight mode, the same one at most every 50 ms.

        Raises UserError if the vehicle has no mode of this name.
        """
        if (vehicle := self._vehicle) is not None:
            numbers = vehicle.condition.modes.command(mode)
            self._command(self._commands.set_mode(mode, numbers, self._clock.now_ns()))

    def arm(self) -> None:
        """Request arming, at most once a second."""
        self._command(self._commands.arm(self._clock.now_ns()))

    def _command(self, request: CommandRequest | None) -> None:
        if request is None or self._vehicle is None or self._config.readonly:
            return
        self._transmit(self._codec.encode_request(self._vehicle.identity.source, request))

    def begin_flight(self, meaning: ActionMeaning, output: Output | None) -> None:
        """Choose the message that carries such actions."""

    def takeoff(self, height_m: float) -> None:
        """Ask the autopilot to climb to this height above the ground by its own means."""

    def announce(self, text: str, *, is_warning: bool = False) -> None:
        """Send a STATUSTEXT, for a pilot who sees only a ground station; read-only, say nothing."""
        if self._config.readonly:
            return
        severity = dialect.MAV_SEVERITY_WARNING if is_warning else dialect.MAV_SEVERITY_NOTICE
        for packet in self._codec.encode_statustext(severity, text):
            self._transmit(packet)

    def _transmit(self, data: bytes) -> bool:
        """Send a packet, after a release that could not be sent; False: it was not sent."""
        if self._release.is_owed and not self._try_release():
            return False
        return self._connection.send(data)

    # --- sticks

    def send(self, decision: Decision) -> Sticks | None:
        """Send sticks or a release; returns the sticks that were really sent, or None.

        Releases leave every 50 ms for as long as they are asked for, up to 80 after the last
        override. One that cannot be sent now is sent before anything else that can.
        """
        if self._config.readonly or self._vehicle is None:
            return None
        if isinstance(decision, Release):
            self._send_release()
            return None
        if not isinstance(decision.action, Sticks):
            raise TypeError(f"{type(decision.action).__name__} cannot be sent yet")
        if self._config.output == "rc-override":
            return self._send_override(decision.action, self._vehicle)
        system = self._vehicle.identity.source.system
        if not self._transmit(self._codec.encode_manual_control(system, decision.action)):
            return None
        self._counters.sent += 1
        return manual_control_sticks(decision.action)

    def _send_override(self, sticks: Sticks, vehicle: VehicleSession) -> Sticks | None:
        calibration = vehicle.calibration
        if calibration is None:
            return None
        pwm_us = vehicle.echo.with_nudge(pwm_of(sticks, calibration), self._clock.now_ns())
        data = self._codec.encode_override(vehicle.identity.source, pwm_us, calibration)
        if self._release.is_owed and not self._try_release():
            return None
        self._release.overridden(calibration)
        if not self._connection.send(data):
            return None
        vehicle.echo.sent(pwm_us, self._clock.now_ns())
        self._counters.sent += 1
        return calibration.to_sticks(pwm_us)

    def _send_release(self) -> None:
        vehicle = self._vehicle
        if vehicle is None or not self._release.left:
            return
        self._was_confirmed |= vehicle.echo.confirmed
        vehicle.echo.released()
        if self._release.is_due(self._clock.now_ns()):
            self._try_release()

    def _try_release(self) -> bool:
        """Send a release; False: it was not sent, and goes before all other packets."""
        vehicle, calibration = self._vehicle, self._release.calibration
        if vehicle is None or calibration is None:
            return True  # nothing was ever overridden
        data = self._codec.encode_release(vehicle.identity.source, calibration)
        is_sent = self._connection.send(data)
        self._release.tried(self._clock.now_ns(), is_sent=is_sent)
        return is_sent

    def close(self) -> None:
        """Free the socket or port."""
        self._connection.close()


def _name(address: Address | None) -> str:
    return "this connection" if address is None else f"{address[0]}:{address[1]}"
