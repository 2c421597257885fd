"""Values that go into the engagement, and what comes out of it."""

from dataclasses import dataclass
from enum import Enum
from typing import Literal, NamedTuple, TypeAlias

from mavbridge.core.reasons import Reason
from mavbridge.core.vehicle import FlightEnd, ModeRoles, Sticks

OperatorCommand: TypeAlias = Literal["engage", "release"]
"""Explicit command of the operator at the terminal."""


class Phase(Enum):
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
    """Throttle down, the rest centred: what arming demands; or a setpoint that stays down."""
    POLICY = "policy"
    NEUTRAL = "neutral"
    """All centred: level, and where the mode holds height, at this height; a setpoint at rest."""
    LEVEL = "level"
    """All but the throttle centred: where the throttle is thrust, its last value stays."""
    RELEASE = "release"
    """None: the sticks are given back."""


class EndRequest(NamedTuple):
    """Why a flight has to end."""

    reason: Reason
    is_fault: bool = False
    end: FlightEnd = "signal"
    """How it ends; of a fault only a takeover is told."""


class Outcome(NamedTuple):
    """How the flights of one guard went so far, for the exit status and the report."""

    flights: int = 0
    """Times that the policy took the sticks."""
    has_left_ground: bool | None = None
    """In any of them; None: the vehicle does not tell."""
    faults: int = 0
    """Flights that a fault of ours ended."""
    is_disarmed: bool = False
    """The last one ended because the vehicle was disarmed, by itself or by somebody."""
    end: FlightEnd | None = None
    """How the last one ended; None before that."""
    fault: Reason | None = None
    """The last of those faults."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Actions:
    """What the guard does at one moment."""

    control: ControlSource | None = None
    """None: nothing is sent."""
    mode: str | None = None
    """Flight mode to request now."""
    arm: bool = False
    """Request to arm now."""
    takeoff_m: float | None = None
    """Request to climb to this height now, by the autopilot's own means."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngagementInputs:
    """Vehicle, link and policy at one moment."""

    now_ns: int
    is_connected: bool
    """A vehicle was found, and its status is known."""
    link_problem: Reason | None
    """Why sticks may not be sent: no heartbeat, set-up not finished, a risk not accepted."""
    interruption: Reason | None
    """Why every engagement so far is over: a reboot, another address; see ``LinkSnapshot``."""
    interruptions: int = 0
    """Number of interruptions so far."""
    overruled: Reason | None
    """Why the vehicle is thought to follow other sticks than ours, or None."""
    is_switched_off: bool
    """The pilot's override switch is low."""
    mode: str
    modes: ModeRoles
    """Modes that this vehicle has; empty before it was found."""
    armed: bool
    is_failsafe: bool
    has_receiver: bool | None
    is_receiver_sick: bool = False
    """The vehicle says now that its receiver does not work."""
    pilot_sticks: Sticks | None
    """Sticks of the receiver, as last seen while we sent none."""
    rc_channels_us: tuple[int, ...]
    """Fresh readings, 0 where there is none."""
    is_position_valid: bool
    height_m: float | None
    """Above the estimator's origin; None without a valid position."""
    is_landed: bool | None
    echo_confirmed: bool
    is_released: bool
    shows_last: bool = True
    """The vehicle shows the last sticks that we sent: held, or a receiver's that rests there."""
    are_sticks_at_rest: bool = True
    """Our last sticks pass for nobody's hand: a mode that flies by itself is not left for them."""
    stick_override_ns: int | None = None
    """When the vehicle last said that moving sticks have changed its mode."""
    refused_mode: str | None
    heard_ns: int | None = None
    """Arrival of the newest packet; None: now."""
    mode_ns: int | None = None
    """Arrival of the newest word about the mode; None: now."""
    channels_ns: int | None = None
    """Arrival of ``rc_channels_us``; None: now."""
    chunk_problem: Reason | None
    """Why a flight may not begin now: no fresh chunk."""
    chunk_fault: Reason | None
    """Why a flight must end now: no chunk for longer than the grace, or a command that failed."""
    command_failed: bool = False
    """The last command could not be made: the vehicle has not been sent it."""
    is_policy_reset: bool = True
    """The newest chunk was solved after a reset for the flight that starts."""
    slowness: Reason | None = None
    """Why the policy can never fly: too slow, or a command that failed."""
    envelope_problem: Reason | None
    """Which limit of the flight envelope is exceeded."""
    landing: Reason | None = None
    """The vehicle has landed under the policy: a normal end."""
