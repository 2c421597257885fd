"""Who holds the sticks: one pure state machine, and the last check of what a policy returns."""

from dataclasses import dataclass
from enum import Enum
from typing import Literal, TypeAlias

import numpy as np

from mavbridge.clock import NS_PER_S
from mavbridge.errors import PeerError
from mavbridge.records import FloatArray, Release

PILOTED_MODES = frozenset(
    {
        *("STABILIZE", "ACRO", "ALT_HOLD", "LOITER", "POSHOLD", "SPORT", "DRIFT"),
        *("MANUAL", "STABILIZED", "ALTCTL", "POSCTL"),
    }
)
"""Modes in which sticks fly the vehicle (ArduPilot, PX4)."""

PREPARE_TIMEOUT_NS = 90 * NS_PER_S
"""For mode change and arming; a cold autopilot needs some 40 s for its estimator."""


class Phase(Enum):
    """Where the flight is."""

    WAITING = "waiting"
    PREPARING = "preparing"
    FLYING = "flying"
    LATCHED = "latched"
    """The pilot took over; only disarming ends this."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Facts:
    """What the state machine looks at, once a tick."""

    now_ns: int
    link_problem: str | None
    input_problem: str | None
    """No fresh state or feature."""
    mode: str | None
    armed: bool
    echo_confirmed: bool


class Hold(Enum):
    """What to do with the sticks when they are not released."""

    IDLE = "idle"
    """Throttle at the bottom, the rest centred: for arming."""
    FLY = "fly"


Ask: TypeAlias = Literal["mode", "arm"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Directive:
    """What to do this tick."""

    sticks: Hold | Release
    ask: Ask | None = None


class Engagement:
    """Decides whether the policy flies. Every path that does not is a ``Release`` with its reason.

    WAITING -> PREPARING (asked to arm or to change mode) -> FLYING; FLYING -> LATCHED when the
    mode changes under us (pilot, failsafe); a problem of link or inputs releases while it lasts.
    """

    def __init__(self, *, wanted_mode: str | None, arm: bool, readonly: bool) -> None:
        self._wanted_mode = wanted_mode.upper() if wanted_mode else None
        self._may_arm = arm
        self._readonly = readonly
        self._flown_mode: str | None = None
        self._prepare_until_ns: int | None = None
        self.phase = Phase.WAITING
        self.engaged_ns: int | None = None
        """First tick of flight."""

    def step(self, facts: Facts) -> Directive:
        """One tick.

        Raises:
            PeerError: the vehicle did not take the mode or arm in time.
        """
        if facts.link_problem is not None:
            return self._wait(facts.link_problem)
        if self._readonly:
            return self._fly(facts)
        if not facts.armed:
            return self._on_ground(facts)
        if self.phase is Phase.LATCHED:
            return Directive(
                sticks=Release(f"the pilot has taken over ({facts.mode}); disarm to reset")
            )
        if self._flown_mode is not None and facts.mode != self._flown_mode:
            self.phase = Phase.LATCHED
            return Directive(
                sticks=Release(f"mode changed from {self._flown_mode} to {facts.mode}")
            )
        return self._in_air(facts)

    def _wait(self, reason: str, ask: Ask | None = None) -> Directive:
        if self.phase is not Phase.LATCHED:
            self.phase = Phase.WAITING
        return Directive(sticks=Release(reason), ask=ask)

    def _on_ground(self, facts: Facts) -> Directive:
        self.phase = Phase.WAITING
        self._flown_mode = None
        if self.engaged_ns is not None or not self._may_arm:  # one arming a flight, never a second
            wants_mode = self.engaged_ns is None and self._wanted_mode not in (None, facts.mode)
            return self._wait(
                "disarmed: arm the vehicle, or start with --arm", "mode" if wants_mode else None
            )
        if self._wanted_mode is None and not self._mode_is_right(facts):
            return self._wait(f"{facts.mode} is not flown with sticks: name one with --mode")
        self._prepare(facts)
        if facts.input_problem is not None or not facts.echo_confirmed:
            return Directive(sticks=Hold.IDLE)
        return Directive(sticks=Hold.IDLE, ask="arm" if self._mode_is_right(facts) else "mode")

    def _in_air(self, facts: Facts) -> Directive:
        if self._mode_is_right(facts):
            return self._fly(facts)
        if self._wanted_mode is None:
            return self._wait(f"{facts.mode} is not flown with sticks")
        if facts.input_problem is not None:
            return self._wait(facts.input_problem)
        self._prepare(facts)
        return Directive(sticks=Release(f"waiting for mode {self._wanted_mode}"), ask="mode")

    def _fly(self, facts: Facts) -> Directive:
        if facts.input_problem is not None:
            return Directive(sticks=Release(facts.input_problem))
        self.phase = Phase.FLYING
        self._flown_mode = facts.mode
        self._prepare_until_ns = None
        if self.engaged_ns is None:
            self.engaged_ns = facts.now_ns
        return Directive(sticks=Hold.FLY)

    def _mode_is_right(self, facts: Facts) -> bool:
        if self._wanted_mode is not None:
            return facts.mode == self._wanted_mode
        return facts.mode in PILOTED_MODES

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
    """Refuse a chunk with a value that is not finite; NaN must never become a stick."""
    if np.isfinite(chunk).all():
        return None
    return Release("the policy returned a value that is not finite")
