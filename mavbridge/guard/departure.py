"""The way out of a flight that ends by our own doing: neutral, a safe mode, then the release."""

from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import FlightEnd, OnFault
from mavbridge.guard.facts import Facts, Hand, Move

NEUTRAL_NS = 50 * NS_PER_MS
"""Least time of neutral sticks before they are given back."""
MODE_SPACING_NS = 100 * NS_PER_MS
"""Between two requests for the safe mode; ArduPilot answers within 10 ms."""
SLOW_SPACING_NS = NS_PER_S
"""The same once a vehicle with a good link has not confirmed it for the timeout."""
MODE_TIMEOUT_NS = 3 * NS_PER_S
"""Longest wait for the safe mode of a vehicle that is heard; HEARTBEAT, which confirms it, may come
at 1 Hz."""
BLIND_NS = 3 * NS_PER_S
"""Longest that a vehicle which is not heard is asked for a mode, where a receiver takes over from
sticks that stay away: a failsafe for want of a ground station comes after 5 s."""
FAILSAFE_BLIND_NS = 500 * NS_PER_MS
"""The same where its own failsafe follows, which must not be undone: after 0.5 s (COM_RC_LOSS_T) or
1 s (RC_FS_TIMEOUT, COM_OF_LOSS_T)."""
SETPOINT_NS = 500 * NS_PER_MS
"""Longest stream of neutral setpoints that waits for the mode on PX4. A vehicle that has not
answered by then does not hear us, and it goes back to OFFBOARD within 30 ms when it hears a
setpoint after its own failsafe (COM_OF_LOSS_T, 1 s)."""
STICK_REST_NS = NS_PER_S
"""Longest wait for our sticks to be at rest before the safe mode is asked for all the same: a jump
over the whole range is slower than PX4's least hand, 0.05 a second, after 0.6 s."""
UNDONE_NS = NS_PER_S
"""A safe mode that PX4 leaves this soon for moving sticks was left for our jump to neutral."""
WORD_NS = 100 * NS_PER_MS
"""Wait for the EVENT that tells it from another station's change of mode, which has none."""
MIDDLE_STICK = 0.2
"""A receiver's throttle this near to the middle holds height or nearly so (ArduPilot's THR_DZ is
0.2 of the stick's travel to each side)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Ending:
    """Why a flight ends by our own doing."""

    reason: Reason
    is_fault: bool = False
    end: FlightEnd = "signal"
    """Code of an end that is no fault."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DepartureSettings:
    """Actions after a fault, and at a normal end."""

    on_fault: OnFault = "auto"
    """auto: release to a hand that would hold the vehicle, else hold."""
    then: OnFault = "auto"
    """auto: release to a hand that would hold the vehicle, else land."""
    is_setpoint: bool = False
    """The policy's actions are setpoints: there is nothing to release to, so that a mode which
    holds stands for release, and silence follows it."""


class Departure:
    """One way out; ``begin`` starts it, ``step`` goes on until ``is_done``."""

    def __init__(self, settings: DepartureSettings) -> None:
        self._settings = settings
        self._began_ns = 0
        self._request_due_ns = 0
        self._is_thrust_mode = False
        self._has_failed = False
        """A command could not be made on this way out."""
        self._asked_ns: int | None = None
        """The safe mode was last asked for."""
        self._entered_ns = 0
        """It was asked for, or seen for the first time after that."""
        self._undone_ns: int | None = None
        """The vehicle was first seen in the mode that it enters for a moving stick."""
        self.mode: str | None = None
        """The safe mode that is asked for; a change to it is no takeover."""
        self._asks_until_ns = 0
        """End of the quick requests: a vehicle that is heard has had its time to confirm."""
        self.is_silence_failsafe = False
        """The vehicle takes the end of our sticks for a failsafe."""
        self._may_release = False
        """The receiver's sticks would hold the vehicle in the mode of the flight."""
        self.must_hold = False
        """Neutral must go on: silence is a failsafe, or the receiver would drop the vehicle."""
        self.note: Reason | None = None
        """Why it is not released, although the flag says so; the reader resets it."""
        self.is_done = False

    def forget(self) -> None:
        """The sticks are released: from now on every mode change is somebody else's."""
        self.mode = None

    def ask_at_once(self, now_ns: int) -> None:
        """Let the next request for the mode wait for no spacing."""
        self._request_due_ns, self._asks_until_ns = now_ns, now_ns + MODE_TIMEOUT_NS

    def begin(self, facts: Facts, ending: Ending) -> None:
        """Choose the safe mode for the vehicle as it is now."""
        self._began_ns = self._request_due_ns = facts.now_ns
        self._asked_ns = self._undone_ns = None
        self._has_failed = False
        self._is_thrust_mode = facts.mode in facts.modes.thrust
        has_receiver = facts.has_receiver is True
        is_setpoint = self._settings.is_setpoint
        self.is_silence_failsafe = not has_receiver or facts.modes.is_silence_failsafe
        self._asks_until_ns = facts.now_ns + MODE_TIMEOUT_NS
        self.is_done = False
        choice = self._settings.on_fault if ending.is_fault else self._settings.then
        objection = self._hand_objection(facts)
        self._may_release = objection is None
        if choice == "release" and facts.is_landed:
            self._may_release = True
        elif choice in ("auto", "release"):
            instead: OnFault = "hold" if ending.is_fault else "land"
            if objection is not None and choice == "release":
                self.note = because(Code.NOT_RELEASED, instead=instead, why=objection)
            choice = "release" if objection is None else instead
        # In a mode of setpoints or of the autopilot's takeoff a pilot's sticks would do nothing.
        is_deaf = facts.mode in (*facts.modes.setpoint, *facts.modes.takeoff)
        if choice == "release" and (is_setpoint or is_deaf):
            choice = "hold"
        if choice == "hold" and not facts.is_position_valid:
            choice = "land"  # BRAKE and LOITER are refused without a position
        roles = facts.modes
        by_choice = {"hold": roles.hold, "land": roles.land, "rtl": roles.rtl}
        self.mode = by_choice.get(choice) or None

    def is_undone(self, facts: Facts) -> bool:
        """True if the vehicle has left our mode for a hand that nobody moved, or may have.

        It shows our sticks, and no others; its EVENT says that sticks were moved.
        """
        is_ours = facts.echo_confirmed and facts.overruled is None
        if self.mode is None or self._asked_ns is None or not is_ours:
            return False
        if facts.mode != facts.modes.override:
            if self._undone_ns is not None:  # back in our mode: another hand needs another word
                self._asked_ns, self._undone_ns = facts.now_ns, None
            return False
        if self._undone_ns is None:
            self._undone_ns = facts.now_ns
        is_soon = self._undone_ns - self._entered_ns <= UNDONE_NS
        is_undecided = facts.now_ns - self._undone_ns <= WORD_NS
        return is_soon and (is_undecided or self._is_told(facts))

    def _is_told(self, facts: Facts) -> bool:
        told_ns = facts.stick_override_ns
        return told_ns is not None and self._asked_ns is not None and told_ns >= self._asked_ns

    def _are_at_rest(self, facts: Facts) -> bool:
        """Neutral sticks have left, and pass for nobody's hand."""
        if self._settings.is_setpoint or not facts.modes.override:
            return True
        is_bounded = facts.now_ns - self._began_ns >= STICK_REST_NS
        self._has_failed = self._has_failed or facts.command_failed
        if self._has_failed:
            return is_bounded  # when neutral left is not known
        return is_bounded or (facts.are_sticks_at_rest and facts.now_ns > self._began_ns)

    def _hand_objection(self, facts: Facts) -> Reason | None:
        """Why the pilot's sticks would not hold the vehicle in its present mode, or None."""
        if facts.has_receiver is not True:
            return because(Code.NO_RECEIVER)
        if facts.is_landed:
            return None
        if facts.is_receiver_sick:
            return because(Code.RECEIVER_LOST)
        if facts.modes.is_silence_failsafe and not self._settings.is_setpoint:
            return because(Code.SILENCE_IS_FAILSAFE)
        if facts.mode in facts.modes.thrust:
            return because(Code.THROTTLE_IS_THRUST, mode=facts.mode)
        if facts.pilot_sticks is None:
            return because(Code.THROTTLE_UNKNOWN)
        throttle = facts.pilot_sticks.throttle
        if abs(throttle) > MIDDLE_STICK:
            percent, most = 100 * throttle, 100 * MIDDLE_STICK
            return because(Code.THROTTLE_RESTS, percent=percent, limit_percent=most)
        return None

    def _may_ask(self, facts: Facts, unheard_ns: int | None) -> bool:
        """The mode is known, or the vehicle's own failsafe cannot have acted yet."""
        has_failsafe = self.is_silence_failsafe or facts.modes.needs_setpoints_first
        blind_ns = FAILSAFE_BLIND_NS if has_failsafe else BLIND_NS
        return unheard_ns is None or facts.now_ns - unheard_ns <= blind_ns

    def step(self, facts: Facts, unheard_ns: int | None = None) -> Move:
        """Neutral, and the mode until it is confirmed or refused.

        ``unheard_ns``: last word of a vehicle that has not told its mode since; None: it is known.
        """
        is_confirmed = self.mode is None or facts.mode == self.mode
        is_safe = self._may_release or (self.mode is not None and is_confirmed)
        self.must_hold = not self._settings.is_setpoint and (
            self.is_silence_failsafe or not is_safe
        )
        if unheard_ns is not None:  # its time to answer begins when it is heard
            self._asks_until_ns = facts.now_ns + MODE_TIMEOUT_NS
        # No vehicle refuses to land: an answer that says so is a late one, to the mode before.
        if not is_confirmed and facts.refused_mode == self.mode:
            self.mode = facts.modes.land or None
        elapsed_ns = facts.now_ns - self._began_ns
        is_undone = self.is_undone(facts)
        if is_confirmed and self._asked_ns is not None and self._entered_ns <= self._asked_ns:
            self._entered_ns = facts.now_ns
        is_late = facts.now_ns >= self._asks_until_ns
        is_over = elapsed_ns >= NEUTRAL_NS if is_confirmed else is_late
        self.is_done = not is_undone and (self.is_done or is_over)
        # Where the throttle is thrust, neutral would climb or fall: the mode goes first. Then it
        # may still be a hand's to the vehicle.
        is_entered = bool(self.mode) and is_confirmed and not facts.modes.override
        is_level_only = self._is_thrust_mode and not is_entered
        hand: Hand | None = Hand.LEVEL if is_level_only else Hand.NEUTRAL
        if self._settings.is_setpoint and facts.is_landed:
            hand = Hand.IDLE  # the thrust that hovers would lift it
        may_pull_back = self._settings.is_setpoint and facts.modes.needs_setpoints_first
        if may_pull_back and elapsed_ns > SETPOINT_NS:
            hand = None
        is_due = facts.now_ns >= self._request_due_ns and self._may_ask(facts, unheard_ns)
        if is_confirmed or not is_due:
            return Move(hand=hand)
        if (is_undone and not self._is_told(facts)) or not self._are_at_rest(facts):
            return Move(hand=hand)
        if not is_undone:
            self._asked_ns = self._entered_ns = facts.now_ns
        is_slow = is_late and facts.link_problem is None  # each refusal prints a reason
        self._request_due_ns = facts.now_ns + (SLOW_SPACING_NS if is_slow else MODE_SPACING_NS)
        return Move(hand=hand, mode=self.mode)
