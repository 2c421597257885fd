"""Link to the vehicle for the guard; one thread owns socket and codec."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial

from mavbridge.core.address import parse_address
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock, period_ns
from mavbridge.core.errors import PeerError
from mavbridge.core.histogram import Histogram
from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import (
    Action,
    ActionMeaning,
    Decision,
    ForwardedPacket,
    LinkArrivals,
    LinkSnapshot,
    LinkStats,
    ModeRoles,
    Outlet,
    Output,
    Sample,
)
from mavbridge.mavlink.codec.messages import (
    Attitude,
    CommandAck,
    CommandRequest,
    Heartbeat,
    LocalVelocity,
    Measurement,
    ReceivedMessage,
    Timesync,
)
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.codec.signing import Signing
from mavbridge.mavlink.codec.tlog import PacketPipe
from mavbridge.mavlink.outputs.sender import ActionSender
from mavbridge.mavlink.session.commands import VehicleCommands
from mavbridge.mavlink.session.discovery import (
    DuplicateSystems,
    VehicleDiscovery,
    VehicleIdentity,
)
from mavbridge.mavlink.session.telemetry import LinkCounters, TelemetryCollector
from mavbridge.mavlink.session.timesync import TimesyncFilter
from mavbridge.mavlink.session.vehicle import VehicleSession
from mavbridge.mavlink.transport.connection import REFUSED_NS, Address, Connection, Transport

_EARLY_REQUEST_NS = 20 * NS_PER_MS
"""Two usual stick periods: a due request leaves before an action, never after it."""
_HEARTBEAT_HZ = 1.0


class MavlinkLink:
    """Non-blocking session with one vehicle over a transport; not thread-safe.

    Once the transport has been opened, its problems appear in the snapshot instead of being raised,
    and it is reopened once a second.

    ``service`` and ``begin_flight`` raise PeerError: no vehicle within the timeout, two of them, or
    one that cannot be flown.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        config: LinkSettings,
        *,
        packet_log: PacketPipe | None = None,
        keeps_packets: bool = False,
        signing: Signing | None = None,
    ) -> None:
        """``keeps_packets``: ``receive`` returns the vehicle's packets too, for a recorder."""
        self._clock, self._config, self._keeps_packets = clock, config, keeps_packets
        self._packets: list[ForwardedPacket] = []
        self._samples: list[Sample] = []
        self._codec = Codec(source_system=config.source_system, signing=signing)
        self._connection = Connection(transport, self._codec, clock, packet_log)
        self._report = self._connection.report
        self.fileno, self.close = self._connection.fileno, self._connection.close
        """Descriptor to wait on for arrivals; release of the socket or port."""
        self.transmit = self._connection.send
        """Sends the packets of ``rehearse``."""
        self._discovery = VehicleDiscovery(target_system=config.target_system)
        self._counters = LinkCounters()
        self._timesync = TimesyncFilter(self._report)
        self._telemetry = TelemetryCollector()
        self.commands = VehicleCommands(self._command, self._report, clock)
        self._sender = ActionSender(self._connection, self._codec, clock)
        self.is_engaged = False
        """True from the way in to the end of the release: only the vehicle's own clock shows that
        it has another address."""
        self._started_ns = self._heartbeat_due_ns = clock.now_ns()
        self.vehicle: VehicleSession | None = None
        """Present session, for reading; None before the vehicle is found."""
        self._old_params: dict[str, float] = {}
        self._watches_home_height = False
        self._interruption: Reason | None = None
        self._interruptions = 0
        self._duplicate_systems = DuplicateSystems()

    def receive(self) -> LinkArrivals:
        """Receive everything that has arrived; never block. ``service`` does the rest."""
        self._receive_all()
        if self.vehicle is not None and self.vehicle.has_rebooted:
            self._interrupt(because(Code.REBOOTED))
            self._adopt(self.vehicle.identity)
        arrivals = LinkArrivals(tuple(self._samples), tuple(self._packets))
        self._samples, self._packets = [], []
        return arrivals

    def snapshot(self) -> LinkSnapshot:
        """Return what the link knows now."""
        now_ns = self._clock.now_ns()
        vehicle, output = self.vehicle, self._sender.output
        status = vehicle.status(now_ns) if vehicle else None
        modes = vehicle.roles(status) if vehicle else ModeRoles()
        problem = self._problem(now_ns)
        snapshot = partial(
            LinkSnapshot,
            telemetry=self._telemetry.telemetry,
            interruption=self._interruption,
            interruptions=self._interruptions,
            texts=self._connection.take_texts(),
        )
        if vehicle is None or output is None:
            problem = problem or because(Code.NO_POLICY_LOADED)
            return snapshot(status=status, problem=problem, modes=modes)
        # A vehicle that receives nothing from us may follow another source.
        others = None if self._connection.is_refused(now_ns) else output.overruled(now_ns)
        return snapshot(
            status=output.in_policy_terms(status, vehicle, now_ns),
            problem=problem or others or output.unheard(now_ns),
            overruled=others,
            is_switched_off=output.is_sticks and vehicle.is_switched_off,
            echo_confirmed=output.echo_confirmed,
            is_released=output.is_released(vehicle, now_ns),
            # The echo of a setpoint tells nothing about a release.
            shows_last=output.is_sticks and output.echo.shows_last,
            are_sticks_at_rest=output.are_sticks_at_rest(vehicle),
            modes=modes if output.is_sticks else replace(modes, is_silence_failsafe=False),
            refused_mode=self.commands.refused_mode,
        )

    def _problem(self, now_ns: int) -> Reason | None:
        """Return why this vehicle cannot be flown now, its echo aside, or None."""
        if self._connection.is_down:
            return because(Code.CONNECTION_LOST)
        if (vehicle := self.vehicle) is None:
            return because(Code.NO_HEARTBEAT)
        if (problem := vehicle.problem(now_ns)) is not None:
            hint = self._timesync.slow_clock or self._connection.hint
            return problem if hint is None else because(Code.WITH_HINT, first=problem, hint=hint)
        if self._connection.is_refused(now_ns) and not self._config.readonly:
            return because(Code.PACKETS_REFUSED, after_ms=REFUSED_NS / NS_PER_MS)
        return vehicle.output_problem(now_ns) or self._timesync.late_sending

    def _receive_all(self) -> None:
        vehicle = self.vehicle
        for message, arrived_ns, sender in self._connection.receive():
            body = message.body
            if isinstance(body, Heartbeat):
                self._discovery.receive(message.source, body, sender, arrived_ns)
            if vehicle is None or message.source != vehicle.identity.source:
                continue
            if sender == vehicle.identity.address or (
                isinstance(body, Attitude) and self._is_moved(vehicle, body, sender, arrived_ns)
            ):
                self._receive(vehicle, message, arrived_ns)
            elif isinstance(body, Heartbeat):
                self._notice_other(vehicle.identity, sender, arrived_ns)

    def _is_moved(
        self, vehicle: VehicleSession, body: Attitude, sender: Address | None, arrived_ns: int
    ) -> bool:
        """True if the engaged vehicle now sends from ``sender``, with its clock running on.

        It is followed so that neutral sticks, the safe mode and the release reach it.
        """
        is_same_clock = self._timesync.is_same_clock(body.boot_us, arrived_ns)
        if not self.is_engaged or not self._duplicate_systems.has_moved(
            sender, arrived_ns, self._counters.heard_ns, is_same_clock=is_same_clock
        ):
            return False
        before, vehicle.identity = vehicle.identity, replace(vehicle.identity, address=sender)
        self._connection.peer = sender
        reason = because(Code.MOVED, before=before.place, now=vehicle.identity.place)
        vehicle.end_engagement(reason, arrived_ns)
        return True

    def _receive(self, vehicle: VehicleSession, message: ReceivedMessage, arrived_ns: int) -> None:
        """Process one message of the chosen vehicle."""
        body, happened_ns = message.body, arrived_ns
        if isinstance(body, LocalVelocity) and not vehicle.condition.is_velocity_usable(arrived_ns):
            self._counters.receive(f"{message.name} (invalid)", message, arrived_ns)
            vehicle.receive(message, arrived_ns)
            return
        name = f"{message.name} (invalid)" if message.is_unusable else message.name
        self._counters.receive(name, message, arrived_ns)
        if isinstance(body, Measurement):
            happened_ns = self._timesync.happened_ns(body.boot_us, arrived_ns)
            self._samples += self._telemetry.receive(body, arrived_ns, happened_ns)
        elif isinstance(body, Timesync):
            self._timesync.receive(body, arrived_ns)
        targets = ((0, 0), self._codec.source)
        is_for_others = isinstance(body, CommandAck) and body.target not in targets
        if isinstance(body, CommandAck) and not is_for_others:
            self.commands.receive(body)
        if not is_for_others:
            before = vehicle.params.interruption
            if (output := self._sender.output) is not None:
                output.receive(message.body, vehicle, arrived_ns)
            vehicle.receive(message, arrived_ns)
            if (changed := vehicle.params.interruption) is not None and changed is not before:
                self._interrupt(changed)
        if self._keeps_packets:
            self._packets.append(ForwardedPacket(arrived_ns, happened_ns, message.packet))

    def _notice_other(self, identity: VehicleIdentity, sender: Address | None, now_ns: int) -> None:
        """Handle another sender with the vehicle's system id, ignored while engaged."""
        heard_ns = self._counters.heard_ns if self.is_engaged else now_ns
        told = self._duplicate_systems.notice(identity, sender, now_ns, heard_ns)
        if isinstance(told, str):
            self._report(told)
        elif told is not None:
            self._interrupt(told)

    def _interrupt(self, reason: Reason) -> None:
        """Note why all engagements so far are over."""
        self._interruption, self._interruptions = reason, self._interruptions + 1
        self._report(str(reason))

    def stats(self) -> LinkStats:
        """Return the counters for the report."""
        counters, timesync, output = self._counters, self._timesync, self._sender.output
        sent, slow_clock = counters.sent, timesync.slow_clock
        error_ns = timesync.error_ns(counters.heard_ns)
        return LinkStats(
            messages_per_s=counters.messages_per_s,
            lost_fraction=counters.lost_fraction,
            rtt_ms=timesync.round_trips.percentiles_ms(),
            sent_actions=sent,
            echo_confirmed=output.was_confirmed if sent and output is not None else None,
            unusable_packets=self._codec.bad_data_count,
            refused_signatures=self._codec.refused_signatures,
            vehicle_clock_offset_ns=timesync.offset_ns,
            is_timesync_good=timesync.is_good,
            slow_clock=None if slow_clock is None else str(slow_clock),
            timesync_error_ms=None if error_ns is None else error_ns / NS_PER_MS,
        )

    @property
    def autopilot(self) -> str:
        """Autopilot and version, for the report."""
        vehicle = self.vehicle
        return f"{vehicle.profile.name} {vehicle.version or ''}".strip() if vehicle else "none"

    @property
    def is_release_owed(self) -> bool:
        """True if a release could not be sent: ``service`` sends it before everything else."""
        return self._sender.is_release_owed

    def restart_counters(self) -> None:
        """Restart the counts of messages, losses and round trips."""
        self._counters = LinkCounters()
        self._timesync.round_trips = Histogram()

    @property
    def known_params(self) -> Mapping[str, float]:
        """The vehicle's flight-relevant parameters by name, for the report."""
        return {} if self.vehicle is None else dict(sorted(self.vehicle.params.values.items()))

    def restore(self) -> bool:
        """Let ``service`` restore the parameters set for the flight; call at every tick until True.

        True: everything is restored, or nothing more can be done; after some 3 s at most.
        """
        return self.vehicle is None or self.vehicle.params.changes.restore()

    def service(self) -> None:
        """Find or follow the vehicle and send due requests. Call after the sticks are sent."""
        now_ns = self._clock.now_ns()
        if self.vehicle is None:
            self._find_vehicle(now_ns)
        elif not self.is_engaged:
            here = self.vehicle.identity
            if (moved := self._discovery.moved(here, now_ns)) is not None:
                if moved.address != here.address:
                    self._interrupt(because(Code.MOVED_AT_REST, before=here.place, now=moved.place))
                self._adopt(moved)
        if self._sender.is_release_owed and not self._sender.try_release():
            return
        if now_ns >= self._heartbeat_due_ns:
            self._heartbeat_due_ns = now_ns + period_ns(_HEARTBEAT_HZ)
            kinds = (self.vehicle.profile.heartbeat_type,) if self.vehicle else ()
            self._connection.send(self._codec.encode_heartbeat(*kinds))
        if (vehicle := self.vehicle) is None:
            return
        for request in vehicle.step(now_ns):
            self._connection.send(self._codec.encode_request(vehicle.identity.source, request))
        self._request_time(now_ns)

    def send_before_action(self) -> None:
        """Send a TIMESYNC request that is due soon, before the next action can fill the queue."""
        if self.vehicle is not None and not self._sender.is_release_owed:
            self._request_time(self._clock.now_ns(), _EARLY_REQUEST_NS)

    def _request_time(self, now_ns: int, early_ns: int = 0) -> None:
        if (ts1 := self._timesync.request(now_ns, early_ns)) is not None:
            self._connection.send(self._codec.encode_timesync(ts1))

    def _find_vehicle(self, now_ns: int) -> None:
        if (identity := self._discovery.choose(now_ns)) is not None:
            self._adopt(identity)
            return
        place, timeout_s = self._config.connect, self._config.connect_timeout_s
        waited_s = (now_ns - self._started_ns) / NS_PER_S
        if waited_s > timeout_s and not self._discovery.is_settling(now_ns):
            address = parse_address(place)
            why = self._discovery.describe(address, waited_s, self._connection, now_ns)
            raise PeerError(f"no vehicle on {place} after {timeout_s:g} s: {why}")

    def _adopt(self, identity: VehicleIdentity) -> None:
        """Start a new session: for a new vehicle, after a reboot or after a change of address."""
        self.vehicle = VehicleSession(
            identity,
            self._config,
            old_params=self._old_params,
            report=self._report,
            has_slow_clock=lambda: self._timesync.slow_clock is not None,
        )
        if self._watches_home_height:
            self.vehicle.watch_home_height()
        self._sender.equip(self.vehicle)
        self._telemetry = TelemetryCollector()
        self._timesync = TimesyncFilter(self._report)
        self.commands.adopt(self.vehicle)
        self._counters.new_sequence()
        self._duplicate_systems = DuplicateSystems()
        self._connection.peer = identity.address

    def begin_flight(
        self, meaning: ActionMeaning, output: Output | None, *, watches_home_height: bool = False
    ) -> None:
        """Choose the output, now or once the vehicle is known; call before the first action.

        ``output`` None: the default of these actions and this vehicle. Telemetry starts anew, so
        that a recording, which begins here, holds the source of every sample.
        """
        self._telemetry = TelemetryCollector()
        self._sender.begin_flight(meaning, output)
        self._watches_home_height = watches_home_height
        if watches_home_height and self.vehicle is not None:
            self.vehicle.watch_home_height()

    def rehearse(
        self, plan: Iterable[tuple[int, Decision | None, str | None]]
    ) -> tuple[tuple[int, bytes], ...]:
        """Encode decisions and mode requests, with delays [ns], as last words; no side effects."""
        return () if self._config.readonly else tuple(self._sender.rehearse(plan))

    @property
    def outlet(self) -> Outlet:
        """Present outlet of packets to the vehicle."""
        return self._connection.outlet

    def _command(self, request: CommandRequest) -> None:
        if (vehicle := self.vehicle) is not None and not self._config.readonly:
            self._sender.transmit(self._codec.encode_request(vehicle.identity.source, request))

    def announce(self, text: str) -> None:
        """Send a STATUSTEXT for pilots who see only a ground station; no-op if read-only."""
        if self._config.readonly:
            return
        for packet in self._codec.encode_statustext(text):
            self._sender.transmit(packet)

    def send(self, decision: Decision, decided_ns: int | None = None) -> Action | None:
        """Send an action or a release. Return the action as sent, or None.

        ``decided_ns``: time for which the action was computed; None: now.

        Releases leave every 50 ms while they are requested, up to the output's number. A failed
        release is sent before anything else. Raises CommandRefusedError for an action that this
        output must not send.
        """
        action = None if self._config.readonly else self._sender.send(decision, decided_ns)
        if action is not None:
            self._counters.sent += 1
        return action
