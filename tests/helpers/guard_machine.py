"""A guard whose vehicle, pilot, link and flight process are set by hand."""

import math
from collections import deque
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from helpers.fakes import FakeClock, level_telemetry
from helpers.guard_facts import engagement_settings, flight_settings, limits_of, make_chunk
from mavbridge.core.clock import NS_PER_MS
from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import (
    NEUTRAL,
    Action,
    ActionMeaning,
    Decision,
    LinkSnapshot,
    OnFault,
    Release,
    Sticks,
    VehicleStatus,
    Velocity,
)
from mavbridge.guard.chunks import Chunk, FreshnessLimits
from mavbridge.guard.guard import Guard, GuardInput, GuardOutput
from mavbridge.guard.limits import Smoothing
from mavbridge.guard.values import EndRequest, FlightSettings, OperatorCommand, Phase
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.px4 import PX4

MS = NS_PER_MS
STEP_NS = 10 * MS
LIMIT_NS, GRACE_NS = 120 * MS, 100 * MS
HORIZON = 16
FLIGHT_MODES = {
    ("ardupilot", "sticks"): "ALT_HOLD",
    ("ardupilot", "velocity"): "GUIDED",
    ("px4", "sticks"): "ALTCTL",
    ("px4", "velocity"): "OFFBOARD",
}
CODES = 200
"""Number of chunks that can be told apart by their actions."""
SEEN_NS, HELD_NS = 40 * MS, 3_000 * MS
"""Until a receiver's sticks are seen after ours, and for which a last setpoint is followed."""


@dataclass
class Vehicle:
    """The vehicle's report about itself."""

    mode: str
    has_receiver: bool
    armed: bool = True
    is_failsafe: bool = False
    switch_us: int = 1500
    """Pulse width of channel 7."""
    radio_ns: int | None = None
    """Last RC_CHANNELS; None: they come."""

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


class Shown(NamedTuple):
    """One decision of the guard."""

    at_ns: int
    kind: str
    """policy, neutral or release."""
    code: int | None
    """Code of the chunk that a policy's action comes from."""
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
    overruled: Reason | None = None
    interruption: Reason | None = None
    interruptions: int = 0
    refused_mode: str | None = None
    is_switched_off: bool = False
    has_chunks: bool = True
    """True if the flight process computes a chunk every 10 ms."""
    odd_chunk: Chunk | None = None
    outputs: deque[GuardOutput] = field(default_factory=lambda: deque(maxlen=4))

    def __post_init__(self) -> None:
        roles = {"ardupilot": ARDUPILOT, "px4": PX4}[self.autopilot].modes.roles
        is_sticks = self.kind == "sticks"
        self.roles = roles if is_sticks else replace(roles, is_silence_failsafe=False)
        self.mode = FLIGHT_MODES[self.autopilot, self.kind]
        self.vehicle = Vehicle(self.mode, self.has_receiver)
        self.guard = Guard(self._settings(), self.clock.now_ns())
        self.chunks: dict[int, Chunk] = {}
        """Chunks available to the guard, by code."""
        self.sent_ns: int | None = None
        """Newest action that was no release."""

    def _settings(self) -> FlightSettings:
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
        return flight_settings(
            meaning=ActionMeaning(kind=self.kind),
            freshness=ages,
            smoothing=Smoothing(limits=free, tau_s=0.0),
            engagement=engagement,
        )

    @property
    def now_ns(self) -> int:
        return self.clock.now_ns()

    @property
    def phase(self) -> Phase:
        return self.guard.engagement.phase

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

    def step(self) -> Shown | None:
        """Wake the guard; return what it decided to send."""
        chunk = self.odd_chunk or (self.chunk() if self.has_chunks else None)
        given = GuardInput(link=self._snapshot(), chunk=chunk, act=self.act, stop=self.stop)
        self.act = self.odd_chunk = None
        done = self.guard.step(self.now_ns, given)
        self.outputs.append(done)
        if done.decision is None:
            return None
        if not isinstance(done.decision, Release):
            self.sent_ns = self.now_ns
        return Shown(self.now_ns, *_meaning(done.decision), self.phase)

    def _snapshot(self) -> LinkSnapshot:
        is_sticks = self.kind == "sticks"
        return LinkSnapshot(
            telemetry=level_telemetry(self.now_ns),
            status=self.vehicle.status(self.now_ns),
            problem=self.link_problem or self.overruled,
            overruled=self.overruled,
            is_switched_off=is_sticks and self.is_switched_off,
            echo_confirmed=True,
            is_released=self._is_released,
            interruption=self.interruption,
            interruptions=self.interruptions,
            modes=self.roles,
            refused_mode=self.refused_mode,
        )

    @property
    def _is_released(self) -> bool:
        """Without a receiver the vehicle shows our last sticks for good."""
        if self.sent_ns is None:
            return True
        since_ns = self.now_ns - self.sent_ns
        if self.kind != "sticks":
            return self.vehicle.mode != self.mode or since_ns > HELD_NS
        return self.has_receiver and since_ns >= SEEN_NS


def _meaning(decision: Decision) -> tuple[str, int | None]:
    """Return kind of a decision, and the code of the policy's chunk that it comes from."""
    if isinstance(decision, Release):
        return "release", None
    if isinstance(decision, Velocity):
        assert abs(decision.x_mps) <= 8.0, decision
        is_policys, code = decision.x_mps > 0.5, (decision.x_mps - 1.0) / 0.01
    else:
        assert isinstance(decision, Sticks), decision
        assert all(abs(value) <= 1.0 for value in decision), decision
        is_policys, code = decision.pitch > 0.15, (decision.pitch - 0.2) / 0.0025
    return ("policy", round(code)) if is_policys else ("neutral", None)
