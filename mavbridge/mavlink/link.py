"""The vehicle as the action loop sees it: poll, send, ask. One thread owns socket and codec."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.config.flight import LinkConfig
from mavbridge.config.rates import HEARTBEAT_HZ, period_ns
from mavbridge.core.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.core.errors import PeerError
from mavbridge.core.records import Decision, LinkSnapshot, LinkStats, Release, Sticks, Telemetry
from mavbridge.mavlink.codec.calibration import RcCalibration
from mavbridge.mavlink.codec.messages import CommandAck, Heartbeat, StatusText, Timesync
from mavbridge.mavlink.codec.requests import AskCommand, AskParam, Request
from mavbridge.mavlink.codec.sticks import Codec, manual_control_sticks, pwm_of
from mavbridge.mavlink.session import params
from mavbridge.mavlink.session.roster import Peer, Roster
from mavbridge.mavlink.session.stats import LinkCounters
from mavbridge.mavlink.session.timesync import TimesyncFilter
from mavbridge.mavlink.session.vehicle import Vehicle
from mavbridge.mavlink.transport.sockets import Transport
from mavbridge.mavlink.transport.tap import PacketTap
from mavbridge.mavlink.transport.wire import Arrival, Wire

SOURCE_COMPONENT = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
RELEASE_REPEATS = 10
RELEASE_SPACING_NS = 50 * NS_PER_MS
"""A release is said ten times over half a second: any one packet may be lost."""
_ASK_AGAIN_NS = NS_PER_S


class MavlinkLink:
    """Implements ``ports.Link`` over a transport.

    Raises from ``tend``:
        PeerError: no vehicle within the timeout, two vehicles, or one that cannot be flown.
    """

    def __init__(
        self,
        transport: Transport,
        clock: Clock,
        config: LinkConfig,
        *,
        state_hz: float,
        tap: PacketTap | None = None,
    ) -> None:
        self._clock = clock
        self._config = config
        self._state_hz = state_hz
        self._codec = Codec(source_system=config.source_system, source_component=SOURCE_COMPONENT)
        self._wire = Wire(transport, self._codec, clock, tap)
        self._roster = Roster(target_system=config.target_system)
        self._counters = LinkCounters()
        self._timesync = TimesyncFilter()
        self._started_ns = clock.now_ns()
        self._beat_due_ns = self._started_ns
        self._vehicle: Vehicle | None = None
        self._calibration: RcCalibration | None = None
        """Of the last override that left: what a release needs, whatever else is lost."""
        self._has_advised = False
        self._has_been_confirmed = False
        self._is_drained = False
        """Whoever waited for the attitude has just taken in all there was."""
        self._release_due_ns = 0
        self._releases_left = 0
        self._asked_ns: dict[int, int] = {}

    # --- coming in

    def poll(self) -> LinkSnapshot:
        """Take in all that has arrived; never blocks. Nothing here that can wait for ``tend``."""
        if not self._is_drained:
            self._receive()
        self._is_drained = False
        if self._vehicle is not None and self._vehicle.has_rebooted:
            self._wire.texts.append("the vehicle has rebooted: starting over")
            self._adopt(self._vehicle.peer)
        return self._snapshot(self._clock.now_ns())

    def service(self) -> None:
        """Find or follow the vehicle, and keep house; called when the sticks have left."""
        now_ns = self._clock.now_ns()
        if self._vehicle is None:
            self._look_for_vehicle(now_ns)
        elif (peer := self._roster.moved(self._vehicle.peer, now_ns)) is not None:
            self._wire.texts.append(f"the vehicle now speaks from {peer.address}: starting over")
            self._adopt(peer)
        self._housekeep(now_ns)

    def wait_for_attitude(self, *, newer_than_ns: int, until_ns: int) -> int:
        """Take in what arrives until an attitude newer than that has come, or until the time."""
        while self._clock.now_ns() < until_ns:
            self._receive()
            if self._attitude_ns() > newer_than_ns:
                self._is_drained = True
                break
            self._wire.wait(until_ns)
        return self._attitude_ns()

    def _attitude_ns(self) -> int:
        return 0 if self._vehicle is None else self._vehicle.telemetry.attitude_ns

    def _receive(self) -> None:
        for arrival in self._wire.receive():
            self._take(arrival)

    def _take(self, arrival: Arrival) -> None:
        message, arrived_ns, sender = arrival
        if isinstance(message.body, Heartbeat):
            self._roster.hear(message.source, message.body, sender, arrived_ns)
        vehicle = self._vehicle
        if vehicle is None or (message.source, sender) != (
            vehicle.peer.source,
            vehicle.peer.address,
        ):
            return
        self._counters.receive(message.name, message.sequence, arrived_ns)
        vehicle.handshake.streams.receive(message.name)
        match message.body:
            case None:
                return
            case Timesync() as reply:
                self._counters.round_trip(self._timesync.receive(reply, arrived_ns))
            case StatusText(text=text):
                self._wire.texts.append(f"vehicle: {text}")
            case CommandAck() as ack if ack.target not in ((0, 0), self._codec.source):
                return  # somebody else's
            case CommandAck() as ack:
                self._tell_refusal(ack)
                vehicle.receive(ack, arrived_ns)
            case body:
                vehicle.receive(body, arrived_ns)

    def _tell_refusal(self, ack: CommandAck) -> None:
        if ack.command not in self._asked_ns or ack.result == dialect.MAV_RESULT_ACCEPTED:
            return
        command = dialect.enums["MAV_CMD"][ack.command].name.removeprefix("MAV_CMD_")
        result = dialect.enums["MAV_RESULT"].get(ack.result)
        reason = result.name.removeprefix("MAV_RESULT_") if result else ack.result
        self._wire.texts.append(f"the vehicle answered {command} with {reason}")

    def _look_for_vehicle(self, now_ns: int) -> None:
        peer = self._roster.choose(now_ns)
        if peer is not None:
            self._adopt(peer)
            return
        waited_ns = now_ns - self._started_ns
        if not self._roster.is_settling and waited_ns > self._config.connect_timeout * NS_PER_S:
            raise PeerError(
                f"no vehicle on {self._config.connect} after {self._config.connect_timeout:g} s: "
                f"{self._roster.describe()}"
            )

    def _adopt(self, peer: Peer) -> None:
        """Start from nothing with this vehicle, at first sight and after it rebooted."""
        self._vehicle = Vehicle(peer, self._config, state_hz=self._state_hz)
        self._counters.new_sequence()
        self._has_advised = False
        self._wire.answer_to(peer.address)

    # --- what is known

    def _snapshot(self, now_ns: int) -> LinkSnapshot:
        texts = tuple(self._wire.texts)
        self._wire.texts.clear()
        vehicle = self._vehicle
        overruled = None if vehicle is None else vehicle.overruled(now_ns)
        return LinkSnapshot(
            telemetry=Telemetry() if vehicle is None else vehicle.telemetry.snapshot(),
            status=None if vehicle is None else vehicle.status(),
            problem=self._problem(now_ns) or overruled,
            is_overruled=overruled is not None,
            echo_confirmed=vehicle is not None and vehicle.echo_confirmed,
            texts=texts,
        )

    def _problem(self, now_ns: int) -> str | None:
        if self._wire.is_down:
            return "the link is down"
        if self._vehicle is None or not self._vehicle.has_beaten:
            return "waiting for the vehicle's heartbeat"
        if self._vehicle.is_lost(now_ns):
            return "the vehicle's heartbeat is lost"
        return self._vehicle.problem()

    def stats(self) -> LinkStats:
        """Figures for the report."""
        has_echo = self._config.output == "rc-override"
        is_confirmed = self._vehicle is not None and self._vehicle.echo.confirmed
        return self._counters.stats(
            echo_confirmed=(self._has_been_confirmed or is_confirmed) if has_echo else None,
            unusable_packets=self._codec.bad_data_count,
            clock_offset_ns=self._timesync.offset_ns,
        )

    @property
    def autopilot(self) -> str:
        """Autopilot and version, for the report."""
        if self._vehicle is None:
            return "none"
        version = self._vehicle.handshake.version or ""
        return f"{self._vehicle.peer.autopilot} {version}".strip()

    # --- going out

    def _housekeep(self, now_ns: int) -> None:
        if now_ns >= self._beat_due_ns:
            self._beat_due_ns = now_ns + period_ns(HEARTBEAT_HZ)
            self._wire.put(self._codec.encode_heartbeat())
        vehicle = self._vehicle
        if vehicle is None:
            return
        for request in vehicle.handshake.step(now_ns):
            self._wire.put(self._encode(request, vehicle.peer))
        if (ts1 := self._timesync.request(now_ns)) is not None:
            self._wire.put(self._codec.encode_timesync(ts1))
        if not self._has_advised and vehicle.handshake.problem is None:
            self._has_advised = True
            self._wire.texts += params.override_advice(vehicle.handshake.values)

    def _encode(self, request: Request, peer: Peer) -> bytes:
        match request:
            case AskCommand():
                return self._codec.encode_command(peer.source, request.command, *request.params)
            case AskParam():
                return self._codec.encode_param_read(peer.source, request.name)
            case _:
                return self._codec.encode_stream_request(
                    peer.source, request.stream, request.rate_hz
                )

    def send(self, decision: Decision) -> Sticks | None:
        """Put the decision on the wire; returns the sticks that really left, or None."""
        if self._config.readonly or self._vehicle is None:
            return None
        if isinstance(decision, Release):
            self._send_release()
            return None
        if self._config.output == "manual-control":
            return self._send_manual_control(decision.sticks, self._vehicle)
        return self._send_override(decision.sticks, self._vehicle)

    def _send_manual_control(self, sticks: Sticks, vehicle: Vehicle) -> Sticks | None:
        if not self._wire.put(
            self._codec.encode_manual_control(vehicle.peer.source.system, sticks)
        ):
            return None
        self._counters.sent += 1
        return manual_control_sticks(sticks)

    def _send_override(self, sticks: Sticks, vehicle: Vehicle) -> Sticks | None:
        calibration = vehicle.calibration
        if calibration is None:
            return None
        pwm_us = vehicle.echo.distinct(pwm_of(sticks, calibration))
        # Before the send: whatever happens after it, this must be given back.
        self._calibration, self._releases_left = calibration, RELEASE_REPEATS
        if not self._wire.put(
            self._codec.encode_override(vehicle.peer.source, pwm_us, calibration)
        ):
            return None
        vehicle.echo.sent(pwm_us, self._clock.now_ns())
        self._counters.sent += 1
        return calibration.to_sticks(pwm_us)

    def _send_release(self, *, is_last_word: bool = False) -> None:
        """Zeros, ten times; then silence, which leaves the channels to whoever else flies."""
        now_ns, vehicle = self._clock.now_ns(), self._vehicle
        if vehicle is None or self._calibration is None or not self._releases_left:
            return
        self._has_been_confirmed |= vehicle.echo.confirmed
        vehicle.echo.released()
        if now_ns < self._release_due_ns and not is_last_word:
            return
        self._release_due_ns = now_ns + RELEASE_SPACING_NS
        data = self._codec.encode_release(vehicle.peer.source, self._calibration)
        if self._wire.put(data, is_last_word=is_last_word):
            self._releases_left -= 1

    def hand_back(self) -> None:
        """Last words: the rest of the releases, properly spaced. Takes up to half a second."""
        if self._config.readonly:
            return
        for _ in range(self._releases_left):
            self._clock.sleep_until_ns(self._release_due_ns)
            self._send_release()

    def force_release(self) -> None:
        """From any thread: nothing but releases leaves from now on, and they leave here.

        For when the thread that owns the link hangs; if it comes back, its sticks stay here.
        """
        self._wire.seal()
        for _ in range(self._releases_left):
            self._send_release(is_last_word=True)
            self._clock.sleep_until_ns(self._clock.now_ns() + RELEASE_SPACING_NS)

    def set_mode(self, mode: str) -> None:
        """Ask for a flight mode, at most once a second."""
        if self._vehicle is not None:
            main, sub = self._vehicle.modes.numbers(mode)
            flags = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            self._ask(self._vehicle, dialect.MAV_CMD_DO_SET_MODE, flags, main, sub)

    def arm(self) -> None:
        """Ask to arm, at most once a second."""
        if self._vehicle is not None:
            self._ask(self._vehicle, dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def _ask(self, vehicle: Vehicle, command: int, *values: float) -> None:
        now_ns = self._clock.now_ns()
        last_ns = self._asked_ns.get(command)
        if self._config.readonly or (last_ns is not None and now_ns - last_ns < _ASK_AGAIN_NS):
            return
        self._asked_ns[command] = now_ns
        self._wire.put(self._codec.encode_command(vehicle.peer.source, command, *values))

    def close(self) -> None:
        """Free the socket or port."""
        self._wire.close()
