"""A guard with its real output and sender; vehicle, pilot and flight process are set by hand."""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

from helpers.fakes import START_NS, FakeClock, level_telemetry
from helpers.flown_vehicle import FlownVehicle
from helpers.guard_facts import engagement_settings, flight_settings, limits_of, make_chunk
from helpers.wire import ARDUPILOT as CALIBRATION
from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import (
    NEUTRAL,
    Action,
    ActionMeaning,
    LinkSnapshot,
    OnFault,
    Output,
    Sticks,
    VehicleStatus,
    Velocity,
)
from mavbridge.guard.chunks import Chunk, FreshnessLimits
from mavbridge.guard.guard import Guard, GuardInput, GuardOutput
from mavbridge.guard.limits import Smoothing
from mavbridge.guard.settings import FlightSettings
from mavbridge.guard.values import EndRequest, OperatorCommand, Phase
from mavbridge.mavlink.codec.messages import Body, ManualControl, RcChannels, VelocityTarget
from mavbridge.mavlink.codec.packets import Codec
from mavbridge.mavlink.outputs.output import ActionOutput
from mavbridge.mavlink.outputs.sender import ActionSender
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.transport.connection import Address, Connection, Received

MS = NS_PER_MS
STEP_NS, SHOWN_NS = 10 * MS, 20 * MS
LIMIT_NS, GRACE_NS = 120 * MS, 100 * MS
HORIZON = 16
FLIGHT_MODES = {
    ("ardupilot", "sticks"): "ALT_HOLD",
    ("ardupilot", "velocity"): "GUIDED",
    ("px4", "sticks"): "ALTCTL",
    ("px4", "velocity"): "OFFBOARD",
}
CODES = 200
"""Number of chunks that can be told apart on the wire."""
JOYSTICK = Sticks(0.3, -0.4, -0.6, -0.5)


class Wire:
    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def open(self) -> None:
        pass

    def close(self) -> None:
        pass

    def fileno(self) -> int | None:
        return None

    def receiver(self, peer: Address | None) -> Address | None:
        return peer

    def drain(self) -> Iterator[Received]:
        return iter(())

    def send(self, data: bytes, peer: Address | None = None) -> bool:
        self.sent.append(data)
        return True


class Copter(FlownVehicle):
    """The vehicle's report about itself, set by hand."""

    is_failsafe = False
    switch_us = 1500
    """Pulse width of channel 7."""
    radio_ns: int | None = None
    """Last RC_CHANNELS; None: they come."""

    def use_output(self, output: Output) -> None:
        pass

    def status(self, now_ns: int) -> VehicleStatus:
        return VehicleStatus(
            mode=self.mode,
            armed=self.armed,
            is_failsafe=self.is_failsafe,
            is_landed=False,
            has_receiver=self.has_receiver,
            pilot_sticks=NEUTRAL if self.has_receiver else None,
            rc_channels_us=() if self.radio_ns else (1500,) * 6 + (self.switch_us, 1500),
            channels_arrived_ns=self.radio_ns,
            rc_arrived_ns=now_ns,
            is_position_valid=True,
            position_ned_m=(0.0, 0.0, -5.0),
        )


@dataclass(frozen=True)
class Shown:
    """One packet for the vehicle, as pymavlink reads it."""

    at_ns: int
    kind: str
    """policy, neutral or release."""
    code: int | None
    """Code of the chunk that a policy's packet comes from."""
    phase: Phase


@dataclass
class GuardWorld:
    """Everything around one guard; ``step`` is one wake-up of it."""

    autopilot: str
    kind: Any
    has_receiver: bool
    on_fault: OnFault
    then: OnFault
    engage_channel: int | None
    clock: FakeClock = field(default_factory=FakeClock)
    serial: int = 0
    act: OperatorCommand | None = None
    stop: EndRequest | None = None
    link_problem: Reason | None = None
    interruption: Reason | None = None
    interruptions: int = 0
    refused_mode: str | None = None
    is_switched_off: bool = False
    has_chunks: bool = True
    """True if the flight process computes a chunk every 10 ms."""
    hears: bool = True
    """True if our messages reach the vehicle."""
    shows: bool = True
    """True if the vehicle's messages that show our sticks reach us."""
    joystick_ns: int = 0
    """Period of another source that sends to the vehicle; 0: none."""
    odd_chunk: Chunk | None = None
    wire: Wire = field(default_factory=Wire)
    packets: list[Shown] = field(default_factory=list)
    outputs: deque[GuardOutput] = field(default_factory=lambda: deque(maxlen=4))

    def __post_init__(self) -> None:
        self.profile = {"ardupilot": ARDUPILOT, "px4": PX4}[self.autopilot]
        self.mode = FLIGHT_MODES[self.autopilot, self.kind]
        self.vehicle = Copter(self.profile, CALIBRATION)
        self.vehicle.mode, self.vehicle.has_receiver = self.mode, self.has_receiver
        meaning = ActionMeaning(kind=self.kind)
        codec = Codec(source_system=255)
        self.sender = ActionSender(Connection(self.wire, codec, self.clock), codec, self.clock)
        self.sender.begin_flight(meaning, None)
        self.sender.equip(self.vehicle)  # type: ignore[arg-type]
        self.guard = Guard(self._settings(meaning), self.clock.now_ns())
        self.end = WireEnd()
        self.chunks: dict[int, Chunk] = {}
        """Chunks available to the guard, by code."""
        self.acts_on: tuple[int, ...] | None = None
        """The last command that reached the vehicle, as the vehicle would show it."""
        self.others_due_ns = self.shown_ns = 0

    def _settings(self, meaning: ActionMeaning) -> FlightSettings:
        free = replace(limits_of(self.kind), change_per_s=(math.inf,) * 4)
        ages = FreshnessLimits(
            state_ns=LIMIT_NS, velocity_ns=LIMIT_NS, feature_ns=2 * LIMIT_NS, chunk_ns=LIMIT_NS
        )
        engagement = engagement_settings(
            modes=(self.mode,),
            is_setpoint=self.kind != "sticks",
            on_fault=self.on_fault,
            then=self.then,
            engage_channel=self.engage_channel,
        )
        smoothing = Smoothing(limits=free, tau_s=0.0)
        return flight_settings(
            meaning=meaning, freshness=ages, smoothing=smoothing, engagement=engagement
        )

    @property
    def output(self) -> ActionOutput:
        assert self.sender.output is not None
        return self.sender.output

    @property
    def now_ns(self) -> int:
        return self.clock.now_ns()

    @property
    def phase(self) -> Phase:
        return self.guard.engagement.phase

    # --- the flight process

    def chunk(self, **changes: Any) -> Chunk:
        """Return a fresh chunk, or one with other stamps or actions."""
        self.serial += 1
        now_ns = self.now_ns
        action: Action = Sticks(0.1, 0.0, 0.2 + 0.0025 * (self.serial % CODES), 0.0)
        if self.kind == "velocity":
            action = Velocity(1.0 + 0.01 * (self.serial % CODES), 0.0, 0.0, 0.0)
        made = make_chunk(
            self.serial, now_ns, age_ns=5 * MS, first_ns=now_ns, actions=(action,) * HORIZON
        )._replace(**changes)
        self.chunks[self.serial % CODES] = made
        return made

    # --- time

    def advance(self, ms: int) -> None:
        """Let time pass; the guard wakes at each slot."""
        for _ in range(0, ms, 10):
            self.clock.advance_ns(STEP_NS)
            self.step()

    def stall(self, ms: int) -> None:
        """Let time pass for the vehicle only."""
        for _ in range(0, ms, 10):
            self.clock.advance_ns(STEP_NS)
            self._show()

    def step(self) -> GuardOutput:
        self._show()
        chunk = self.odd_chunk or (self.chunk() if self.has_chunks else None)
        given = GuardInput(link=self._snapshot(), chunk=chunk, act=self.act, stop=self.stop)
        self.act = self.odd_chunk = None
        done = self.guard.step(self.now_ns, given)
        self.outputs.append(done)
        if done.decision is not None:
            self.sender.send(done.decision)
        self._take()
        return done

    def _snapshot(self) -> LinkSnapshot:
        """Return the snapshot that the link would make from output and session."""
        output, now_ns = self.output, self.now_ns
        vehicle: Any = self.vehicle
        others = output.overruled(now_ns)
        roles = self.profile.modes.roles
        return LinkSnapshot(
            telemetry=level_telemetry(now_ns),
            status=output.in_policy_terms(vehicle.status(now_ns), vehicle, now_ns),
            problem=self.link_problem or others or output.unheard(now_ns),
            overruled=others,
            is_switched_off=output.is_sticks and self.is_switched_off,
            echo_confirmed=output.echo_confirmed,
            is_released=output.is_released(vehicle, now_ns),
            shows_last=output.is_sticks and output.echo.shows_last,
            interruption=self.interruption,
            interruptions=self.interruptions,
            modes=roles if output.is_sticks else replace(roles, is_silence_failsafe=False),
            refused_mode=self.refused_mode,
        )

    # --- the vehicle

    def _show(self) -> None:
        """Send the vehicle's message with the command that it acts on, every 20 ms."""
        if self.joystick_ns and self.now_ns >= self.others_due_ns:
            self.others_due_ns = self.now_ns + self.joystick_ns
            self.acts_on = self._as_shown(JOYSTICK)
        if self.now_ns - self.shown_ns < SHOWN_NS:
            return
        self.shown_ns = self.now_ns
        acts_on = self.acts_on
        if acts_on is None and self.has_receiver:
            acts_on = self._as_shown(NEUTRAL)
        if self.shows and acts_on is not None:
            vehicle: Any = self.vehicle
            self.output.receive(self._body(acts_on), vehicle, self.now_ns)

    def _as_shown(self, sticks: Sticks) -> tuple[int, ...]:
        if self.kind == "velocity":
            return (-700,)
        if self.autopilot == "px4":
            return (round(1000 * sticks.pitch), round(1000 * sticks.roll), 500, 0)
        return CALIBRATION.to_pwm_us(sticks)

    def _body(self, acts_on: tuple[int, ...]) -> Body:
        boot_us = (self.now_ns - START_NS) // 1000 + 1
        if self.kind == "velocity":
            return VelocityTarget(0x5C7, (0.0, 0.0, acts_on[0] / 1000))
        if self.autopilot == "px4":
            return ManualControl(*acts_on)
        throttle, yaw, pitch, roll = acts_on
        channels_us = (roll, pitch, throttle, yaw, 1500, 1500, self.vehicle.switch_us, 1500)
        return RcChannels(channels_us, boot_us)

    def _take(self) -> None:
        """Read the sent packets by pymavlink; the vehicle acts on them if it hears them."""
        sent, self.wire.sent[:] = list(self.wire.sent), []
        for data in sent:
            (message,) = self.end.read(data)
            kind, code, acts_on = _meaning(message)
            self.packets.append(Shown(self.now_ns, kind, code, self.phase))
            if self.hears:
                self.acts_on = acts_on


def _meaning(m: Any) -> tuple[str, int | None, tuple[int, ...] | None]:
    """Return kind and code of a packet, and the vehicle's echo of it."""
    match m.get_type():
        case "RC_CHANNELS_OVERRIDE":
            acts_on = (m.chan3_raw, m.chan4_raw, m.chan2_raw, m.chan1_raw)
            if acts_on == (0, 0, 0, 0):
                return "release", None, None
            assert all(1100 <= us <= 1900 for us in acts_on), acts_on
            return _kind((1500 - m.chan2_raw) / 400), _code((1500 - m.chan2_raw) / 400), acts_on
        case "MANUAL_CONTROL":
            assert all(abs(v) <= 1000 for v in (m.x, m.y, m.r)), m
            assert 0 <= m.z <= 1000, m
            return _kind(m.x / 1000), _code(m.x / 1000), (m.x, m.y, m.z, m.r)
        case "SET_POSITION_TARGET_LOCAL_NED":
            assert abs(m.vx) <= 8.0, m
            code = round((m.vx - 1.0) / 0.01) if m.vx > 0.5 else None
            return ("neutral" if code is None else "policy"), code, (round(1000 * m.vz),)
    raise AssertionError(f"{m.get_type()} was sent")


def _kind(pitch: float) -> str:
    return "policy" if pitch > 0.15 else "neutral"


def _code(pitch: float) -> int | None:
    return round((pitch - 0.2) / 0.0025) if pitch > 0.15 else None
