"""Inputs and outputs of the engagement, and the guard's settings."""

from dataclasses import dataclass
from enum import Enum, StrEnum
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.link_settings import LinkSettings
from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import (
    ActionMeaning,
    FlightEnd,
    LinkSnapshot,
    OnFault,
    Output,
    VehicleStatus,
)
from mavbridge.guard.chunks import FreshnessLimits
from mavbridge.guard.envelope import EnvelopeLimits
from mavbridge.guard.limits import Smoothing

OperatorCommand: TypeAlias = Literal["engage", "release"]
"""Explicit command of the operator at the terminal."""


NOT_FOUND = VehicleStatus(mode="unknown", armed=False)
"""Status before a vehicle has been found."""


class Phase(StrEnum):
    """State of the engagement."""

    WAITING = "waiting"
    PREPARING = "preparing"
    FLYING = "flying"
    LEAVING = "leaving"
    HOLDING = "holding"
    RELEASING = "releasing"
    RELEASED = "released"
    ENDED = "ended"


class ControlSource(Enum):
    """Source of the actions that the guard sends."""

    IDLE = "idle"
    """Throttle down, the rest centred, as arming demands; or a setpoint that stays down."""
    POLICY = "policy"
    NEUTRAL = "neutral"
    """All centred: level, at constant height if the mode holds height; or a setpoint at rest."""
    LEVEL = "level"
    """Throttle at its last value, the rest centred; for modes in which the throttle is thrust."""
    RELEASE = "release"
    """No source: the sticks are given back."""


class EndRequest(NamedTuple):
    """Request to end a flight, with its reason."""

    reason: Reason
    end: FlightEnd = "signal"
    """How the flight ends."""

    @property
    def is_planned(self) -> bool:
        """True if ``--then`` follows, not ``--on-fault``."""
        return self.end not in ("takeover", "disarmed", "fault")


class GuardOutcome(NamedTuple):
    """Outcome of one guard's flights so far, for the exit status and the report."""

    flights: int = 0
    """Number of times that the policy took control."""
    has_left_ground: bool | None = None
    """True if the vehicle left the ground in any flight; None: it does not report it."""
    end: FlightEnd | None = None
    """How the last flight ended; None before that."""
    fault: Reason | None = None
    """Newest fault of ours that has ended a flight; None: none has."""
    failure: Reason | None = None
    """Why there was no flight: the vehicle did not take the mode or arm in time."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngagementSettings:
    """Permitted ways to engage, and what follows a flight."""

    modes: tuple[str, ...]
    """Modes in which the policy may fly."""
    mode: str | None = None
    """Mode to request, one of ``modes``; None: the present one, or the first of ``modes`` if we arm
    the vehicle."""
    is_setpoint: bool = False
    """True if the policy's actions are setpoints, not sticks: no sticks can take over, so a mode
    that holds replaces the release, followed by silence."""
    arm: bool = False
    """Arm once and engage once, as soon as everything is ready."""
    takeoff_m: float | None = None
    """Height above the arming place to which the autopilot climbs autonomously, if we arm the
    vehicle."""
    engage_channel: int | None = None
    """Receiver channel, counted from 1, that engages when it goes high after a rest in low."""
    engage_on_arm: bool = False
    """Engage when the vehicle is armed for the first time."""
    readonly: bool = False
    """Run the policy without sending anything."""
    duration_ns: int | None = None
    """Flight time from the first engagement; None: no limit."""
    on_fault: OnFault = "auto"
    """auto: release if a hand would hold the vehicle, else hold."""
    then: OnFault = "auto"
    """At a normal end. auto: release if a hand would hold the vehicle, else land."""
    keeps_place: bool = False
    """True: at an end, auto holds the vehicle before a hand gets it, for a policy that stops."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngagementOutput:
    """Output of the engagement at one moment."""

    control: ControlSource | None = None
    """None: send nothing."""
    mode: str | None = None
    """Flight mode to request now."""
    arm: bool = False
    """Request to arm now."""
    takeoff_m: float | None = None
    """Height of an autonomous takeoff to request now."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngagementInputs:
    """State of the vehicle, the link and the policy at one moment."""

    now_ns: int
    link: LinkSnapshot
    heard_ns: int | None = None
    """Newest arrival of a mode, RC_CHANNELS or an attitude; None: now."""
    chunk_problem: Reason | None
    """Why no flight may begin now: no fresh chunk."""
    chunk_fault: Reason | None
    """Why a flight must end now: no chunk for longer than the grace."""
    command_fault: Reason | None = None
    """Why the last command failed, so that the vehicle has not received it."""
    is_policy_reset: bool
    """True if the newest chunk was solved after the reset for the flight that starts."""
    slowness: Reason | None = None
    """Why the policy can never fly: it is too slow."""
    envelope_problem: Reason | None
    """The exceeded limit of the flight envelope, or None."""
    landing: Reason | None = None
    """Landing under the policy, a normal end; None: none."""

    @property
    def status(self) -> VehicleStatus:
        """The vehicle's status, or ``NOT_FOUND``."""
        return self.link.status or NOT_FOUND


@dataclass(frozen=True, slots=True, kw_only=True)
class Slot:
    """One slot of the stick grid that has come due."""

    index: int
    due_ns: int
    missed: int
    """Number of earlier slots for which no stick left within one period."""


class StickGrid:
    """Fixed grid of slots at ``origin + index * period``.

    A slot is served by the first send from half a period before it to one period after it. A slot
    that was served early is skipped. A slot without a send in time is missed, and never made up
    for.
    """

    def __init__(self, period_ns: int, origin_ns: int) -> None:
        self._period_ns = period_ns
        self._origin_ns = origin_ns
        self._index = -1
        self._served_ns = self._before_ns = origin_ns - period_ns
        """Last send, or last slot with nothing to send; and the one before."""

    @property
    def next_ns(self) -> int:
        """Time of the next slot."""
        return self._origin_ns + (self._index + 1) * self._period_ns

    def take(self, now_ns: int) -> Slot | None:
        """Return the newest slot that has come due since the last call; None: nothing to serve."""
        index = (now_ns - self._origin_ns) // self._period_ns
        if index <= self._index:
            return None
        first, self._index = self._index + 1, index
        missed = index - first
        unserved_ns = self._origin_ns + first * self._period_ns - self._served_ns
        if unserved_ns < self._period_ns // 2:
            if not missed:
                return None
            missed -= 1
        elif unserved_ns >= self._period_ns + self._period_ns // 2:
            missed += 1  # the slot taken before, whose send was refused
        due_ns = self._origin_ns + index * self._period_ns
        return Slot(index=index, due_ns=due_ns, missed=missed)

    def serve(self, sent_ns: int) -> None:
        """Note that sticks were sent, or that there was nothing to send."""
        self._before_ns, self._served_ns = self._served_ns, sent_ns

    def unserve(self) -> None:
        """Take the last ``serve`` back: the link refused the sticks."""
        self._served_ns = self._before_ns


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardSettings:
    """Settings of the link and of the process, known before a policy is loaded."""

    link: LinkSettings
    realtime: bool = True
    """Use real-time scheduling if the system permits it."""
    tlog_fd: int | None = None
    """Write end of the telemetry log's pipe."""
    keeps_packets: bool = False
    """Forward the vehicle's packets to a recorder."""
    wall_offset_ns: int = 0
    """Wall time minus the monotonic clock, for the telemetry log."""


@dataclass(frozen=True, slots=True, kw_only=True)
class FlightSettings:
    """Settings of a flight, known once its policy is loaded."""

    meaning: ActionMeaning
    output: Output | None = None
    """Message that carries the actions; None: the default of their kind and the vehicle."""
    stick_period_ns: int
    chunk_period_ns: int
    """Time between the policy's chunks."""
    freshness: FreshnessLimits
    smoothing: Smoothing
    envelope: EnvelopeLimits
    engagement: EngagementSettings
    watches_home_height: bool
    """True if the policy takes the height above home: it is requested from the vehicle."""
    watches_position: bool
    """True if the policy takes a position: the flight process is told while a valid one exists."""
