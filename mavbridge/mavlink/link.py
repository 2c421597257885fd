"""The vehicle as the action loop sees it: poll, send, ask. One thread owns socket and codec."""

from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.clock import NS_PER_MS, NS_PER_S, Clock
from mavbridge.config import HEARTBEAT_HZ, RC_CHANNELS_HZ, LinkConfig, period_ns
from mavbridge.errors import PeerError
from mavbridge.mavlink import params, streams
from mavbridge.mavlink.codec import Codec, manual_control_sticks
from mavbridge.mavlink.echo import EchoCheck, Pwm
from mavbridge.mavlink.handshake import Handshake
from mavbridge.mavlink.messages import (
    Attitude,
    AutopilotVersion,
    Body,
    CommandAck,
    Heartbeat,
    Incoming,
    LocalVelocity,
    ParamValue,
    RcChannels,
    SpecificForce,
    StatusText,
    Timesync,
)
from mavbridge.mavlink.modes import ModeTable
from mavbridge.mavlink.requests import AskCommand, AskParam, Request
from mavbridge.mavlink.roster import Peer, Roster
from mavbridge.mavlink.stats import LinkCounters
from mavbridge.mavlink.telemetry import TelemetryJoiner
from mavbridge.mavlink.timesync import TimesyncFilter
from mavbridge.mavlink.transport import Chunk, Transport, TransportDownError
from mavbridge.records import (
    Command,
    Decision,
    LinkSnapshot,
    LinkStats,
    Release,
    Sticks,
    VehicleStatus,
)

SOURCE_COMPONENT = dialect.MAV_COMP_ID_ONBOARD_COMPUTER
HEARTBEAT_TIMEOUT_NS = 3 * NS_PER_S
"""Beats come at 1 Hz: three lost in a row are a lost vehicle."""
RELEASE_REPEATS = 10
RELEASE_SPACING_NS = 50 * NS_PER_MS
"""A release is said ten times over half a second: any one packet may be lost."""
_REOPEN_NS = NS_PER_S
_ASK_AGAIN_NS = NS_PER_S
_REBOOT_STEP_MS = 1000
_SWITCH_ON_US = 1800
"""ArduPilot's threshold of a high auxiliary switch."""


class MavlinkLink:
    """Implements ``ports.Link`` over a transport.

    Raises from ``poll``:
        PeerError: no vehicle within the timeout, two vehicles, or one that cannot be flown.
    """

    def __init__(
        self, transport: Transport, clock: Clock, config: LinkConfig, *, state_hz: float
    ) -> None:
        self._transport = transport
        self._clock = clock
        self._config = config
        self._state_hz = state_hz
        self._codec = Codec(source_system=config.source_system, source_component=SOURCE_COMPONENT)
        self._roster = Roster(target_system=config.target_system)
        self._started_ns = clock.now_ns()
        self._reopen_ns: int | None = None
        self._beat_due_ns = self._started_ns
        self._texts: list[str] = []
        self._counters = LinkCounters()
        self._timesync = TimesyncFilter()
        self._peer: Peer | None = None
        self._release_due_ns = 0
        self._releases_left = 0
        self._has_been_confirmed = False
        self._asked_ns: dict[int, int] = {}
        transport.open()

    # --- coming in

    def poll(self) -> LinkSnapshot:
        """Take in all that has arrived, do the housekeeping that is due; never blocks."""
        now_ns = self._clock.now_ns()
        self._reopen_if_due(now_ns)
        self._drain(now_ns)
        if self._peer is None:
            self._look_for_vehicle(now_ns)
        self._housekeep(now_ns)
        return self._snapshot(now_ns)

    def _drain(self, now_ns: int) -> None:
        if self._reopen_ns is not None:
            return
        try:
            for chunk in self._transport.drain():
                for message in self._codec.decode(chunk.data):
                    self._take(message, chunk)
        except TransportDownError as error:
            self._lose(str(error), now_ns)

    def wait_for_attitude(self, *, newer_than_ns: int, until_ns: int) -> int:
        """Take in what arrives until an attitude newer than that has come, or until the time."""
        while (now_ns := self._clock.now_ns()) < until_ns:
            self._drain(now_ns)
            if self._attitude_ns() > newer_than_ns:
                break
            if self._reopen_ns is not None:
                self._clock.sleep_until_ns(until_ns)
            else:
                self._transport.wait(until_ns)
        return self._attitude_ns()

    def _attitude_ns(self) -> int:
        return self._telemetry.attitude_ns if self._peer is not None else 0

    def _lose(self, reason: str, now_ns: int) -> None:
        self._transport.close()
        self._reopen_ns = now_ns + _REOPEN_NS
        self._texts.append(f"link lost ({reason}); reconnecting")

    def _reopen_if_due(self, now_ns: int) -> None:
        if self._reopen_ns is None or now_ns < self._reopen_ns:
            return
        self._reopen_ns = None
        try:
            self._transport.open()
        except TransportDownError as error:
            self._lose(str(error), now_ns)

    def _look_for_vehicle(self, now_ns: int) -> None:
        peer = self._roster.choose(now_ns)
        if peer is not None:
            self._adopt(peer)
        elif now_ns - self._started_ns > self._config.connect_timeout * NS_PER_S:
            raise PeerError(
                f"no vehicle on {self._config.connect} after {self._config.connect_timeout:g} s: "
                f"{self._roster.describe()}"
            )

    def _adopt(self, peer: Peer) -> None:
        """Start from nothing with this vehicle, at first sight and after it rebooted."""
        needs_calibration = self._config.output == "rc-override"
        if needs_calibration and peer.autopilot == "px4":
            raise PeerError(
                "PX4 takes RC_CHANNELS_OVERRIDE literally and has no release: "
                "use --output manual-control"
            )
        self._peer = peer
        self._counters.new_sequence()
        self._transport.answer_to(peer.address)
        self._modes = ModeTable(autopilot=peer.autopilot, vehicle_type=peer.vehicle_type)
        self._telemetry = TelemetryJoiner()
        self._echo = EchoCheck()
        self._beat: tuple[int, Heartbeat] | None = None
        self._rc: tuple[int, RcChannels] | None = None
        self._boot_ms = 0
        self._has_advised = False
        self._handshake = Handshake(
            needs_calibration=needs_calibration,
            wanted=streams.groups(state_hz=self._state_hz, rc_hz=RC_CHANNELS_HZ),
        )

    def _take(self, message: Incoming, chunk: Chunk) -> None:
        if isinstance(message.body, Heartbeat):
            self._roster.hear(message.source, message.body, chunk.sender, chunk.arrived_ns)
        if self._peer is None or message.source != self._peer.source:
            return
        self._counters.receive(message.name, message.sequence, chunk.arrived_ns)
        self._handshake.streams.receive(message.name)
        if message.body is not None:
            self._take_body(message.body, chunk.arrived_ns)

    def _take_body(self, body: Body, arrived_ns: int) -> None:  # noqa: C901 - one case a message
        match body:
            case Attitude():
                self._watch_reboot(body)
                self._telemetry.attitude(body, arrived_ns)
            case LocalVelocity():
                self._telemetry.velocity(body, arrived_ns)
            case SpecificForce():
                self._telemetry.force(body, arrived_ns)
            case RcChannels():
                self._rc = (arrived_ns, body)
                if (pwm_us := self._stick_channels_us(body)) is not None:
                    self._echo.received(pwm_us, arrived_ns)
            case Heartbeat():
                self._beat = (arrived_ns, body)
            case CommandAck():
                self._take_ack(body)
            case ParamValue():
                self._handshake.receive_param(body)
            case AutopilotVersion():
                self._handshake.receive_version(body)
            case Timesync():
                self._counters.round_trip(self._timesync.receive(body, arrived_ns))
            case StatusText():
                self._texts.append(f"vehicle: {body.text}")

    def _watch_reboot(self, attitude: Attitude) -> None:
        if attitude.boot_ms + _REBOOT_STEP_MS < self._boot_ms and self._peer is not None:
            self._texts.append("the vehicle has rebooted: starting over")
            self._adopt(self._peer)
        self._boot_ms = attitude.boot_ms

    def _take_ack(self, ack: CommandAck) -> None:
        self._handshake.receive_ack(ack)
        if ack.command in self._asked_ns and ack.result != dialect.MAV_RESULT_ACCEPTED:
            command = dialect.enums["MAV_CMD"][ack.command].name.removeprefix("MAV_CMD_")
            result = dialect.enums["MAV_RESULT"].get(ack.result)
            reason = result.name.removeprefix("MAV_RESULT_") if result else ack.result
            self._texts.append(f"the vehicle answered {command} with {reason}")

    def _stick_channels_us(self, rc: RcChannels) -> Pwm | None:
        calibration = self._handshake.calibration
        if calibration is None or len(rc.channels_us) < 8:
            return None
        t, y, p, r = (rc.channels_us[channel.number - 1] for channel in calibration.channels)
        return t, y, p, r

    # --- what is known

    def _snapshot(self, now_ns: int) -> LinkSnapshot:
        texts, self._texts = tuple(self._texts), []
        if self._peer is None:
            return LinkSnapshot(
                telemetry=TelemetryJoiner().snapshot(),
                status=None,
                problem="waiting for the vehicle's heartbeat",
                texts=texts,
            )
        return LinkSnapshot(
            telemetry=self._telemetry.snapshot(),
            status=self._status(self._peer),
            problem=self._problem(now_ns),
            echo_confirmed=self._config.output != "rc-override" or self._echo.confirmed,
            texts=texts,
        )

    def _status(self, peer: Peer) -> VehicleStatus | None:
        if self._beat is None:
            return None
        beat_ns, beat = self._beat
        rc_sticks = None
        if self._rc and self._handshake.calibration:
            pwm_us = self._stick_channels_us(self._rc[1])
            if pwm_us is not None and all(pwm_us):
                rc_sticks = self._handshake.calibration.to_sticks(pwm_us)
        return VehicleStatus(
            system_id=peer.source.system,
            autopilot=peer.autopilot,
            mode=self._modes.name(beat.custom_mode),
            armed=bool(beat.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED),
            heartbeat_ns=beat_ns,
            rc_sticks=rc_sticks,
            rc_channels_us=self._rc[1].channels_us if self._rc else (),
            rc_arrived_ns=self._rc[0] if self._rc else None,
        )

    def _problem(self, now_ns: int) -> str | None:
        if self._beat is None:
            return "waiting for the vehicle's heartbeat"
        if now_ns - self._beat[0] > HEARTBEAT_TIMEOUT_NS:
            return "the vehicle's heartbeat is lost"
        if (problem := self._handshake.problem) is not None:
            return problem
        if self._config.output != "rc-override":
            return None
        if (channel := params.override_switch(self._handshake.values)) is not None:
            values = self._rc[1].channels_us if self._rc else ()
            if len(values) < channel or values[channel - 1] < _SWITCH_ON_US:
                return f"the override switch (RC{channel}) is off"
        return self._echo_problem(now_ns)

    def _echo_problem(self, now_ns: int) -> str | None:
        if not self._echo.failed(now_ns):
            return None
        reasons = list(
            params.override_obstacles(self._handshake.values, self._config.source_system)
        )
        if self._rc is None or now_ns - self._rc[0] > NS_PER_S:
            reasons.append("no RC_CHANNELS arrives to check against")
        if not reasons:
            reasons.append("another station may be overriding, or the receiver has priority")
        return f"the vehicle does not act on our sticks: {'; '.join(reasons)}"

    def stats(self) -> LinkStats:
        """Figures for the report."""
        has_echo = self._config.output == "rc-override" and self._peer is not None
        return self._counters.stats(
            echo_confirmed=self._has_been_confirmed or self._echo.confirmed if has_echo else None
        )

    @property
    def autopilot(self) -> str:
        """Autopilot and version, for the report."""
        if self._peer is None:
            return "none"
        return f"{self._peer.autopilot} {self._handshake.version or ''}".strip()

    # --- going out

    def _housekeep(self, now_ns: int) -> None:
        if now_ns >= self._beat_due_ns:
            self._beat_due_ns = now_ns + period_ns(HEARTBEAT_HZ)
            self._put(self._codec.encode_heartbeat())
        if self._peer is None:
            return
        for request in self._handshake.step(now_ns):
            self._put(self._encode(request, self._peer))
        if (ts1 := self._timesync.request(now_ns)) is not None:
            self._put(self._codec.encode_timesync(ts1))
        if not self._has_advised and self._handshake.problem is None:
            self._has_advised = True
            self._texts += params.override_advice(self._handshake.values)

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

    def _put(self, data: bytes) -> None:
        if self._reopen_ns is not None:
            return
        try:
            self._transport.send(data)
        except TransportDownError as error:
            self._lose(str(error), self._clock.now_ns())

    def send(self, decision: Decision) -> Sticks | None:
        """Put the decision on the wire; returns the sticks that really left, None on release."""
        if self._config.readonly or self._peer is None:
            return None
        if isinstance(decision, Release):
            self._send_release(self._peer)
            return None
        return self._send_command(decision, self._peer)

    def _send_command(self, command: Command, peer: Peer) -> Sticks | None:
        if self._config.output == "manual-control":
            self._put(self._codec.encode_manual_control(peer.source.system, command.sticks))
            self._counters.sent += 1
            return manual_control_sticks(command.sticks)
        calibration = self._handshake.calibration
        if calibration is None:
            return None
        self._put(self._codec.encode_override(peer.source, command.sticks, calibration))
        pwm_us = calibration.to_pwm_us(command.sticks)
        self._echo.sent(pwm_us, self._clock.now_ns())
        self._counters.sent += 1
        self._releases_left = RELEASE_REPEATS
        return calibration.to_sticks(pwm_us)

    def _send_release(self, peer: Peer) -> None:
        """Zeros, ten times; then silence, which leaves the channels to whoever else flies."""
        calibration = self._handshake.calibration
        now_ns = self._clock.now_ns()
        if calibration is None or not self._releases_left or now_ns < self._release_due_ns:
            return
        self._has_been_confirmed |= self._echo.confirmed
        self._echo.released()
        self._releases_left -= 1
        self._release_due_ns = now_ns + RELEASE_SPACING_NS
        self._put(self._codec.encode_release(peer.source, calibration))

    def hand_back(self) -> None:
        """Last words: the rest of the releases, properly spaced. Takes up to half a second."""
        if self._peer is None or self._config.readonly:
            return
        for _ in range(self._releases_left):
            self._clock.sleep_until_ns(self._release_due_ns)
            self._send_release(self._peer)

    def set_mode(self, mode: str) -> None:
        """Ask for a flight mode, at most once a second."""
        main, sub = self._modes.numbers(mode)
        flags = dialect.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
        self._ask(dialect.MAV_CMD_DO_SET_MODE, flags, main, sub)

    def arm(self) -> None:
        """Ask to arm, at most once a second."""
        self._ask(dialect.MAV_CMD_COMPONENT_ARM_DISARM, 1)

    def _ask(self, command: int, *values: float) -> None:
        now_ns = self._clock.now_ns()
        last_ns = self._asked_ns.get(command)
        if self._peer is None or (last_ns is not None and now_ns - last_ns < _ASK_AGAIN_NS):
            return
        self._asked_ns[command] = now_ns
        self._put(self._codec.encode_command(self._peer.source, command, *values))

    def close(self) -> None:
        """Free the socket or port."""
        self._transport.close()
