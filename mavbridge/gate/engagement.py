"""Who holds the sticks: a pure state machine, and the check of every chunk a policy returns."""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Literal, TypeAlias

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.records import FloatArray
from mavbridge.core.vehicle import Release

PILOTED_MODES = (
    *("STABILIZE", "ACRO", "ALT_HOLD", "LOITER", "POSHOLD", "SPORT", "DRIFT"),
    *("MANUAL", "STABILIZED", "ALTCTL", "POSCTL"),
)
"""Modes in which sticks fly the vehicle (ArduPilot, PX4)."""

RETAKE_NS = NS_PER_S // 2
"""How long inputs must be good again before the policy takes the sticks back, so that control does
not pass between pilot and policy several times a second."""

PREPARE_TIMEOUT_NS = 90 * NS_PER_S
"""For mode change and arming; a cold autopilot needs some 40 s for its estimator."""


class Phase(Enum):
    """State of the engagement."""

    WAITING = "waiting"
    PREPARING = "preparing"
    FLYING = "flying"
    LATCHED = "latched"
    """The pilot took over; only disarming ends this."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """Inputs of the state machine at one tick."""

    now_ns: int
    link_problem: str | None
    input_problem: str | None
    mode: str | None
    armed: bool
    is_overruled: bool
    echo_confirmed: bool


class Hold(Enum):
    """Use of the sticks while they are not released."""

    IDLE = "idle"
    FLY = "fly"


Request: TypeAlias = Literal["mode", "arm"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Directive:
    """Output of the state machine at one tick."""

    sticks: Hold | Release
    request: Request | None = None


class Engagement:
    """Decides whether the policy flies. Every path that does not is a ``Release`` with its reason.

    WAITING -> PREPARING (asked to arm or to change mode) -> FLYING. A takeover by
    somebody else ends it: a mode change in the air, or a vehicle that no longer acts on our sticks,
    leads to LATCHED, which only disarming ends. A problem of link or inputs releases the sticks for
    as long as it lasts.
    """

    def __init__(self, *, wanted_mode: str | None, arm: bool, readonly: bool) -> None:
        self._wanted_mode = wanted_mode.upper() if wanted_mode else None
        self._may_arm = arm
        self._readonly = readonly
        self._own_mode: str | None = None
        """The mode that we fly in, or asked for and got; any change of it is a takeover."""
        self._prepare_until_ns: int | None = None
        self._retake_ns: int | None = None
        """Not before this time, after an input failed in flight."""
        self.phase = Phase.WAITING
        self.engaged_ns: int | None = None
        """First tick of flight."""

    def step(self, facts: Facts) -> Directive:
        """Advance by one tick.

        Raises:
            PeerError: the vehicle did not take the mode or arm in time.
        """
        if self._readonly:
            return (
                self._fly(facts) if facts.link_problem is None else self._wait(facts.link_problem)
            )
        if facts.armed:
            self._may_arm = False  # armed once, by anybody: never arm a second time
        if facts.is_overruled and self.phase is Phase.FLYING:
            self.phase = Phase.LATCHED
        if facts.link_problem is not None:
            return self._wait(facts.link_problem)
        if not facts.armed:
            return self._on_ground(facts)
        if self.phase is Phase.LATCHED:
            reason = f"somebody else has taken over ({facts.mode}): disarm to reset"
            return Directive(sticks=Release(reason))
        if self._own_mode is not None and facts.mode != self._own_mode:
            self.phase = Phase.LATCHED
            return Directive(sticks=Release(f"mode changed from {self._own_mode} to {facts.mode}"))
        return self._in_air(facts)

    def _wait(self, reason: str, request: Request | None = None) -> Directive:
        if self.phase is Phase.PREPARING:
            self.phase = Phase.WAITING
        return Directive(sticks=Release(reason), request=request)

    def _on_ground(self, facts: Facts) -> Directive:
        self.phase = Phase.WAITING
        wants_mode = self._wanted_mode is not None and not self._has_wanted_mode(facts)
        if self.engaged_ns is not None:
            self._own_mode = None
            return self._wait("disarmed: the flight is over, or arm it yourself")
        if not self._may_arm:
            self._own_mode = None
            request: Request | None = "mode" if wants_mode else None
            return self._wait("disarmed: arm the vehicle, or start with --arm", request)
        if self._wanted_mode is None and facts.mode not in PILOTED_MODES:
            return self._wait(f"{facts.mode} is not flown with sticks: name one with --mode")
        self._prepare(facts)
        if facts.input_problem is not None or not facts.echo_confirmed:
            return Directive(sticks=Hold.IDLE)
        return Directive(sticks=Hold.IDLE, request="mode" if wants_mode else "arm")

    def _has_wanted_mode(self, facts: Facts) -> bool:
        """Return whether the wanted mode is active; from then on a change of it is a takeover."""
        if facts.mode == self._wanted_mode:
            self._own_mode = facts.mode
        return facts.mode == self._wanted_mode

    def _in_air(self, facts: Facts) -> Directive:
        if self._wanted_mode is None:
            if facts.mode in PILOTED_MODES:
                return self._fly(facts)
            return self._wait(f"{facts.mode} is not flown with sticks")
        if self._has_wanted_mode(facts):
            return self._fly(facts)
        if facts.input_problem is not None:
            return self._wait(facts.input_problem)
        self._prepare(facts)
        return Directive(sticks=Release(f"waiting for mode {self._wanted_mode}"), request="mode")

    def _fly(self, facts: Facts) -> Directive:
        if facts.input_problem is not None:
            if self.engaged_ns is not None:
                self._retake_ns = facts.now_ns + RETAKE_NS
            return Directive(sticks=Release(facts.input_problem))
        if self._retake_ns is not None and facts.now_ns < self._retake_ns:
            reason = "inputs are good again: waiting to see that they stay so"
            return Directive(sticks=Release(reason))
        self.phase = Phase.FLYING
        self._own_mode = facts.mode
        self._prepare_until_ns = None
        if self.engaged_ns is None:
            self.engaged_ns = facts.now_ns
        return Directive(sticks=Hold.FLY)

    def _prepare(self, facts: Facts) -> None:
        self.phase = Phase.PREPARING
        if self._prepare_until_ns is None:
            self._prepare_until_ns = facts.now_ns + PREPARE_TIMEOUT_NS
        elif facts.now_ns > self._prepare_until_ns:
            raise PeerError(
                f"the vehicle is not ready after {PREPARE_TIMEOUT_NS // NS_PER_S} s "
                f"(mode {facts.mode}, armed {facts.armed}, overrides seen {facts.echo_confirmed}, "
                f"inputs {facts.input_problem or 'fine'}): see its messages above"
            )


def check_chunk(chunk: FloatArray) -> Release | None:
    """Refuse a chunk that is not [1, horizon, 4], or holds a value that is not finite."""
    if chunk.ndim != 3 or chunk.shape[0] != 1 or not chunk.shape[1] or chunk.shape[2] != 4:
        return Release(f"the policy returned {list(chunk.shape)} instead of [1, horizon, 4]")
    if not math.isfinite(chunk.sum()):  # one pass; NaN and infinity survive every sum
        return Release("the policy returned a value that is not finite")
    return None
