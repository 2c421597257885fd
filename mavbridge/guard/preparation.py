"""The way into a flight: mode, arming, and a takeoff by the autopilot's own means."""

from dataclasses import dataclass
from typing import NamedTuple

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.guard.facts import Facts, Hand, Move

REQUEST_SPACING_NS = NS_PER_S
"""Between two requests to arm or for a mode: each refused one prints the vehicle's reason."""
ARRIVED = 0.9
"""Share of the takeoff height at which the policy's mode is asked for."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PreparationSettings:
    """The state that the vehicle has to be in before the policy flies."""

    modes: tuple[str, ...]
    """Modes in which the policy may fly."""
    mode: str | None = None
    """The one of them to ask for; None = the present one, or when we arm it the first of modes."""
    takeoff_m: float | None = None
    """Height above the place of arming to which the autopilot climbs by itself, when we arm it."""
    is_setpoint: bool = False
    """The policy's actions are setpoints, and not sticks."""


FLOW_NS = 100 * NS_PER_MS
"""Setpoints flow for so long before a mode is asked for that needs them: PX4 took OFFBOARD 20 ms
after the first, and refused it when asked together with it."""


class Preparing(NamedTuple):
    """One step of preparing."""

    move: Move
    waits_for: Reason | None
    """What is missing; None: ready to fly."""


class Preparation:
    """One way in; ``begin`` starts it, ``step`` goes on until it waits for nothing."""

    def __init__(self, settings: PreparationSettings) -> None:
        self._settings = settings
        self._request_due_ns = 0
        self._ground_m: float | None = None
        self._is_up = False
        self._asked_mode: str | None = None
        self._flows_from_ns: int | None = None
        """First setpoint of those that a mode needs before it is entered."""
        self._lends_sticks = False
        """The mode was refused to a vehicle in the air that has no sticks: neutral ones flow."""
        self.arms = False
        """It was disarmed when this began: we keep it idle on the ground, and arm it."""

    def begin(self, facts: Facts) -> None:
        """Start with the vehicle as it is now."""
        self.arms = not facts.armed
        self._is_up = self._settings.takeoff_m is None or not self.arms
        self._asked_mode = self._ground_m = self._flows_from_ns = None
        self._lends_sticks = False

    @property
    def has_sticks(self) -> bool:
        """Ours are the vehicle's while this goes on."""
        return self.arms or self._lends_sticks

    @property
    def is_taking_off(self) -> bool:
        """The autopilot is to climb, or climbs, by its own means."""
        return not self._is_up

    def is_own_mode(self, facts: Facts) -> bool:
        """The present mode was asked for, or is one that the autopilot's takeoff goes through."""
        has_takeoff = self._settings.takeoff_m is not None and self.arms
        return facts.mode == self._asked_mode or (has_takeoff and facts.mode in facts.modes.takeoff)

    def may_change_mode(self, facts: Facts) -> bool:
        """An act asks for another mode: the flag's, or one that only our setpoints can enter."""
        if self._settings.mode is not None:
            return facts.mode != self._settings.mode
        needs_flow = self._settings.is_setpoint and facts.modes.needs_setpoints_first
        return needs_flow and facts.mode not in self._settings.modes

    def wanted_mode(self, facts: Facts) -> str | None:
        """Mode to ask for; None if the present one will do."""
        wanted = self._settings.mode
        if self.is_taking_off:
            wanted = facts.mode if facts.armed else next(iter(facts.modes.takeoff), None)
        elif wanted is None and facts.mode not in self._settings.modes:
            known = [mode for mode in self._settings.modes if mode in facts.modes.names]
            wanted = known[0] if known else self._settings.modes[0]
        return None if wanted == facts.mode else wanted

    def impossibility(self, facts: Facts) -> Reason | None:
        """Why waiting will not help, or None."""
        names, wanted = facts.modes.names, self.wanted_mode(facts)
        if wanted is None or not names or wanted in names:
            return facts.slowness
        return because(Code.NO_SUCH_MODE, mode=wanted, modes=", ".join(names))

    def step(self, facts: Facts, objection: Reason | None) -> Preparing:
        """Advance; with an ``objection`` nothing new is asked for."""
        self._watch_climb(facts)
        wanted = self.wanted_mode(facts)
        climb_m = self._settings.takeoff_m if self.is_taking_off and facts.armed else None
        self._lend_sticks(facts, wanted)
        hand = self._hand(facts, wanted)
        if facts.armed and wanted is None and climb_m is None and objection is None:
            return Preparing(Move(hand=hand), None)
        waits_for = objection or self._waits_for(facts, wanted, climb_m)
        is_heard = facts.armed or facts.echo_confirmed
        if objection is not None or not is_heard or facts.now_ns < self._request_due_ns:
            return Preparing(Move(hand=hand), waits_for)
        if hand is Hand.NEUTRAL and (self._settings.is_setpoint or self._lends_sticks):
            if self._flows_from_ns is None:
                self._flows_from_ns = facts.now_ns
            if facts.now_ns - self._flows_from_ns < FLOW_NS:
                return Preparing(Move(hand=hand), waits_for)
        if climb_m is not None and facts.is_landed is False:
            return Preparing(Move(hand=hand), waits_for)
        self._request_due_ns = facts.now_ns + REQUEST_SPACING_NS
        self._asked_mode = wanted
        is_arming = wanted is None and not facts.armed
        return Preparing(Move(hand=hand, mode=wanted, arm=is_arming, takeoff_m=climb_m), waits_for)

    def _lend_sticks(self, facts: Facts, wanted: str | None) -> None:
        """Send neutral sticks once a mode was refused that PX4 enters only with some.

        From then on silence would be a failsafe.
        """
        is_refused = wanted is not None and facts.refused_mode == wanted == self._asked_mode
        is_flown = wanted not in facts.modes.setpoint and not self._settings.is_setpoint
        lacks_sticks = facts.modes.needs_sticks_first and facts.has_receiver is False
        if is_refused and is_flown and lacks_sticks and not self.has_sticks:
            self._lends_sticks, self._request_due_ns = True, facts.now_ns

    def _watch_climb(self, facts: Facts) -> None:
        if not facts.armed:
            self._ground_m = facts.height_m
        elif self.is_taking_off and facts.height_m is not None:
            assert self._settings.takeoff_m is not None
            self._ground_m = facts.height_m if self._ground_m is None else self._ground_m
            climbed_m = facts.height_m - self._ground_m
            self._is_up = climbed_m >= ARRIVED * self._settings.takeoff_m

    def _waits_for(self, facts: Facts, wanted: str | None, climb_m: float | None) -> Reason:
        if self.is_taking_off and facts.height_m is None:
            return because(Code.TAKEOFF_NEEDS_POSITION)
        if climb_m is not None:
            return because(Code.TAKING_OFF, height_m=climb_m)
        if wanted is not None:
            return because(Code.WAITING_FOR_MODE, mode=wanted)
        return because(Code.WAITING_FOR_ARMING)

    def _hand(self, facts: Facts, wanted: str | None) -> Hand | None:
        """What to send meanwhile.

        Somebody who has armed it keeps the sticks until the policy takes them. Setpoints end a
        takeoff, but some modes are only entered while they flow.
        """
        is_climbing = self.arms and facts.armed and self._settings.takeoff_m is not None
        if facts.link_problem is not None:
            # Sticks that end are a failsafe where there is no receiver, also if we hear nothing.
            return Hand.NEUTRAL if is_climbing and not self._settings.is_setpoint else None
        if self._settings.is_setpoint:
            if self.is_taking_off:
                return None
            if self.arms and self._settings.takeoff_m is None:
                return Hand.IDLE
            mode = wanted or facts.mode  # and once entered, it is kept only by them
            needs_flow = facts.modes.needs_setpoints_first and mode in facts.modes.setpoint
            return Hand.NEUTRAL if needs_flow else None
        if not self.has_sticks:
            return None
        return Hand.NEUTRAL if is_climbing or self._lends_sticks else Hand.IDLE
