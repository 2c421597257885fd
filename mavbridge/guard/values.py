"""Inputs and outputs of the engagement."""

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
    is_fault: bool = False
    end: FlightEnd = "signal"
    """How the flight ends; "fault" is recorded with ``is_fault``, unless this is "takeover" or
    "disarmed"."""


class Outcome(NamedTuple):
    """Outcome of one guard's flights so far, for the exit status and the report."""

    flights: int = 0
    """Number of times that the policy took control."""
    has_left_ground: bool | None = None
    """True if the vehicle left the ground in any flight; None: it does not report it."""
    faults: int = 0
    """Number of flights ended by a fault of ours."""
    is_disarmed: bool = False
    """True if the last flight ended by disarming, by the vehicle itself or by a person."""
    end: FlightEnd | None = None
    """How the last flight ended; None before that."""
    fault: Reason | None = None
    """Newest fault of ours."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Actions:
    """Actions of the guard at one moment."""

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
    is_connected: bool
    """True if a vehicle has been found and its status is known."""
    link_problem: Reason | None
    """Why sticks must not be sent: no heartbeat, unfinished handshake, a risk not accepted."""
    interruption: Reason | None
    """Why all engagements so far are over: a reboot or a new address; see ``LinkSnapshot``."""
    interruptions: int = 0
    """Number of interruptions so far."""
    overruled: Reason | None
    """Why the vehicle seems to follow other sticks than ours, or None."""
    is_switched_off: bool
    """True if the pilot's override switch is low."""
    mode: str
    modes: ModeRoles
    """Modes of this vehicle; empty before it is found."""
    armed: bool
    is_failsafe: bool
    has_receiver: bool | None
    is_receiver_sick: bool = False
    """True if the vehicle reports that its receiver does not work."""
    pilot_sticks: Sticks | None
    """The receiver's sticks when we last sent none."""
    rc_channels_us: tuple[int, ...]
    """Fresh radio channels, 0 if undriven; empty if stale."""
    is_position_valid: bool
    height_m: float | None
    """Height above the estimator's origin; None without a valid position."""
    is_landed: bool | None
    echo_confirmed: bool
    is_released: bool
    shows_last: bool = True
    """True if the vehicle shows our last sticks, or a receiver's that look the same."""
    are_sticks_at_rest: bool = True
    """True if our last sticks do not look like a hand, which would end an autonomous mode."""
    stick_override_ns: int | None = None
    """Vehicle's last report that moving sticks have changed its mode."""
    refused_mode: str | None
    heard_ns: int | None = None
    """Arrival of the newest packet; None: now."""
    mode_ns: int | None = None
    """Arrival of the newest message that reports the mode; None: now."""
    channels_ns: int | None = None
    """Arrival of ``rc_channels_us``; None: now."""
    chunk_problem: Reason | None
    """Why no flight may begin now: no fresh chunk."""
    chunk_fault: Reason | None
    """Why a flight must end now: no chunk for longer than the grace, or a failed command."""
    command_failed: bool = False
    """True if the last command failed, so that the vehicle has not received it."""
    is_policy_reset: bool = True
    """True if the newest chunk was solved after the reset for the flight that starts."""
    slowness: Reason | None = None
    """Why the policy can never fly: too slow, or a failed command."""
    envelope_problem: Reason | None
    """The exceeded limit of the flight envelope, or None."""
    landing: Reason | None = None
    """Landing under the policy, a normal end; None: none."""


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
        self._served_ns = origin_ns - period_ns
        """Last send, or last slot with nothing to send."""

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
        first_ns = self._origin_ns + first * self._period_ns
        if first_ns - self._served_ns < self._period_ns // 2:
            if not missed:
                return None
            missed -= 1
        due_ns = self._origin_ns + index * self._period_ns
        return Slot(index=index, due_ns=due_ns, missed=missed)

    def serve(self, sent_ns: int) -> None:
        """Note that sticks were sent, or that there was nothing to send."""
        self._served_ns = sent_ns
