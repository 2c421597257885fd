"""Who holds the sticks: one pure state machine. docs/SAFETY.md has its table.

Taking the sticks needs an explicit act; losing them is final until the next one.
"""

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from enum import Enum
from typing import Literal, TypeAlias

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.switch import Switch
from mavbridge.core.vehicle import FlightEnd
from mavbridge.guard.departure import STICK_REST_NS, Departure, DepartureSettings, Ending
from mavbridge.guard.facts import Facts, Hand, Move
from mavbridge.guard.outcome import Outcome
from mavbridge.guard.preparation import Preparation, PreparationSettings

PREPARE_TIMEOUT_NS = 90 * NS_PER_S
"""For mode change and arming; a cold autopilot needs some 40 s for its estimator."""
SLOWEST_CLIMB_MPS = 1.0
"""Slowest takeoff by the autopilot, for which the time above is prolonged; 1.5 m/s are usual."""
ACT_TIMEOUT_NS = 3 * NS_PER_S
"""For the change of mode that an act asks for while armed: no act comes true much later."""
RELEASE_TIMEOUT_NS = NS_PER_S
"""Wait for the vehicle to show other sticks than ours. Without a receiver it never does."""
UNHEARD_RELEASE_TIMEOUT_NS = 4 * NS_PER_S
"""The same where it does not even show the last ones that we sent, so that the releases may be lost
as well: longer than it holds ours on its own (RC_OVERRIDE_TIME, 3 s by default)."""
LOST_NS = 30 * NS_PER_S
"""A vehicle that was held for so long without a word from it is gone: nothing can be held."""
_REHEARSED_MS = (0, 20, 40, *range(100, 2000, 50))
"""Moments after the guard's death at which its last words are said; the first of them close
together, since a packet that the guard sent in part swallows the next one."""
_ASKED_NS = 250 * NS_PER_MS
"""How long they ask for a mode: any longer, and they could undo a mode that the pilot chose."""
_RELEASES = 5
SILENCE_NS = 250 * NS_PER_MS
"""After a silence of the vehicle, or a standstill of our own, of this length its mode is not known
until it is told anew: its own failsafe may have acted, after 0.5 s at the earliest."""
BACKLOG_NS = 50 * NS_PER_MS
"""After a standstill, time for what was under way to come out of pipes and sockets."""
REST_NS = 1_800 * NS_PER_MS
"""Least rest of the engage switch, low, before going high is an act: receivers that dropped out for
0.6 to 1.5 s, with a preset that puts the switch low, have looked like a hand."""


class Phase(Enum):
    """State of the engagement."""

    WAITING = "waiting"
    """Nobody has asked us to fly."""
    PREPARING = "preparing"
    """Asked to; the vehicle is brought into its mode and armed, the sticks idle on the ground."""
    FLYING = "flying"
    LEAVING = "leaving"
    """The flight ends by our own doing: neutral sticks, and a safe mode until it is confirmed."""
    HOLDING = "holding"
    """Neutral goes on, since without a receiver silence is a failsafe: until disarmed or taken."""
    RELEASING = "releasing"
    """The sticks are given back, until the vehicle confirms it."""
    RELEASED = "released"
    """Given back, with a reason; only an explicit act ends this."""
    ENDED = "ended"
    """The guard may exit."""


Act: TypeAlias = Literal["engage", "release"]
"""Explicit acts of the operator at the terminal."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EngagementSettings:
    """The acts that may engage, and the modes in which they may."""

    preparation: PreparationSettings
    arm: bool = False
    """Arm once and engage once, as soon as everything is ready."""
    engage_channel: int | None = None
    """Receiver channel, from 1, that engages when it goes high after a rest low."""
    engage_on_arm: bool = False
    """Engage when the vehicle is armed for the first time."""
    readonly: bool = False
    """Fly without sending anything."""
    duration_ns: int | None = None
    """Flight time from the first engagement on; None = until told otherwise."""
    departure: DepartureSettings


class Engagement:
    """Decides who holds the sticks; ``step`` is called at every wake of the guard."""

    def __init__(self, settings: EngagementSettings, *, chunk_period_ns: int = 0) -> None:
        """``chunk_period_ns``: between chunks; the first one after a reset may take two."""
        self._settings = settings
        self._first_chunk_ns = ACT_TIMEOUT_NS + 2 * chunk_period_ns
        self._departure = Departure(settings.departure)
        self._wants_arm = settings.arm
        self._own_mode: str | None = None
        """The mode that we fly in, or asked for and got; any change of it is a takeover."""
        self._preparation = Preparation(settings.preparation)
        self._is_setpoint = settings.preparation.is_setpoint
        self._prepare_timeout_ns = self._prepare_until_ns = 0
        self._released_ns = 0
        self._heard_ns = 0
        """While leaving or holding: the link was last without a problem."""
        self._stepped_ns: int | None = None
        self._unheard_ns: int | None = None
        """The vehicle's last word before a silence or a standstill; None: its mode is known."""
        self._news_from_ns = 0
        """What has arrived before tells of the time before the silence."""
        self._was_armed: bool | None = None
        """As last seen; None before the vehicle was found."""
        self._has_been_armed = False
        self.starting_ns: int | None = None
        """When all was ready but the policy, which is reset then; None before and after."""
        self._was_ready = False
        """The vehicle was armed at the last step of preparing."""
        self._switch = Switch(rest_ns=REST_NS)
        self._seen_interruptions = 0
        self._stop_reason: Ending | None = None
        self._must_end = False
        """The stop has not been acted upon."""
        self.phase = Phase.WAITING
        self.reason: Reason | None = because(Code.NOT_ENGAGED)
        """Why the policy does not fly; None while it does."""
        self.refusal: Reason | None = None
        """Why the last explicit act had no effect, or what the vehicle has not confirmed; the
        reader resets it."""
        self.failure: Reason | None = None
        """Why there was no flight: the vehicle did not take the mode or arm in time."""
        self.engaged_ns: int | None = None
        """First moment of flight."""
        self.outcome = Outcome()

    def stop(self, ending: Ending) -> None:
        """End: give the sticks back as ``ending`` says, and then be ``ENDED``."""
        if self._stop_reason is None:
            self._stop_reason = ending
            self._must_end = True

    def step(self, facts: Facts, act: Act | None) -> Move:
        """Advance to the facts of this moment."""
        if self._settings.readonly:
            return self._watch(facts)
        self._listen(facts)
        act = self._explicit_act(facts, act)
        if act == "engage" and self.phase in (Phase.LEAVING, Phase.HOLDING, Phase.RELEASING):
            self.refusal = _not_engaged(because(Code.STILL_ENDING, phase=self.phase.value))
        match self.phase:
            case Phase.WAITING | Phase.RELEASED | Phase.ENDED:
                return self._rest(facts, act)
            case Phase.PREPARING:
                return self._prepare(facts, act)
            case Phase.FLYING:
                return self._fly(facts, act)
            case Phase.LEAVING | Phase.HOLDING:
                return self._leave(facts, act)
            case Phase.RELEASING:
                return self._release(facts)

    def _listen(self, facts: Facts) -> None:
        """Find out whether the mode is that of now."""
        now_ns, stepped_ns = facts.now_ns, self._stepped_ns
        heard_ns = now_ns if facts.heard_ns is None else facts.heard_ns
        mode_ns = now_ns if facts.mode_ns is None else facts.mode_ns
        self._stepped_ns = now_ns
        stood_still = stepped_ns is not None and now_ns - stepped_ns > SILENCE_NS
        if stood_still or now_ns - heard_ns > SILENCE_NS:
            if self._unheard_ns is None:
                self._unheard_ns = heard_ns if stepped_ns is None else min(heard_ns, stepped_ns)
            self._news_from_ns = now_ns + (BACKLOG_NS if stood_still else 0)
        elif mode_ns > self._news_from_ns:
            self._unheard_ns = None

    # --- explicit acts

    def _explicit_act(self, facts: Facts, act: Act | None) -> Act | None:
        """The operator's act, or that of the switch, or of the first arming."""
        if self._is_switched_on(facts):
            act = act or "engage"
        is_first_arming = facts.armed and self._was_armed is False and not self._has_been_armed
        if is_first_arming and self._settings.engage_on_arm:
            act = act or "engage"
        if facts.is_connected:
            self._was_armed = facts.armed
            self._has_been_armed = self._has_been_armed or facts.armed
        return act

    def _is_switched_on(self, facts: Facts) -> bool:
        """The engage switch has gone high, by a hand.

        Low takes the sticks back at once, whoever says it; for an act the receiver has to be well.
        """
        channel = self._settings.engage_channel
        if channel is None or len(facts.rc_channels_us) < channel:
            return False
        arrived_ns = facts.now_ns if facts.channels_ns is None else facts.channels_ns
        was_off = self._switch.is_off
        is_act = self._switch.read(facts.rc_channels_us[channel - 1], arrived_ns)
        if facts.is_failsafe or facts.is_receiver_sick:
            self._switch.forget()
            is_act = False
        if was_off and not self._switch.is_off and not is_act:
            rest_s = REST_NS / NS_PER_S
            why = because(Code.SWITCH_NOT_RESTED, channel=channel, rest_s=rest_s)
            self.refusal = _not_engaged(why)
        return is_act

    def _objection(self, facts: Facts) -> Reason | None:
        """Why the policy may not take the sticks of an armed vehicle now, or None."""
        if facts.link_problem is not None:
            return facts.link_problem
        if facts.is_failsafe:
            return because(Code.FAILSAFE, mode=facts.mode)
        if self._switch.is_off:
            return self._switch_off
        return facts.envelope_problem

    @property
    def _switch_off(self) -> Reason:
        return because(Code.ENGAGE_SWITCH_OFF, channel=self._settings.engage_channel or 0)

    def _mode_objection(self, facts: Facts) -> Reason | None:
        if facts.mode in self._settings.preparation.modes:
            return None
        allowed = " or ".join(self._settings.preparation.modes)
        return because(Code.WRONG_MODE, mode=facts.mode, allowed=allowed)

    # --- phases

    def _rest(self, facts: Facts, act: Act | None) -> Move:
        """The sticks are the pilot's, and nothing is sent."""
        if self._is_over(facts):
            self.stop(Ending(reason=because(Code.DURATION)))
        if self._stop_reason is not None:
            self.phase = Phase.ENDED
            return Move()
        if self.phase is Phase.WAITING:
            self.reason = self._waiting_reason(facts)
        if self._wants_arm and facts.link_problem is None:
            self._wants_arm = False
            climb_s = (self._settings.preparation.takeoff_m or 0.0) / SLOWEST_CLIMB_MPS
            return self._begin_preparing(facts, PREPARE_TIMEOUT_NS + round(climb_s * NS_PER_S))
        if act != "engage":
            return Move()
        if not facts.armed:
            self.refusal = _not_engaged(because(Code.NOT_ARMED))
        elif (objection := self._objection(facts) or facts.chunk_problem) is not None or (
            not self._preparation.may_change_mode(facts)
            and (objection := self._mode_objection(facts)) is not None
        ):
            self.refusal = _not_engaged(objection)
        else:
            return self._begin_preparing(facts, ACT_TIMEOUT_NS)
        return Move()

    def _waiting_reason(self, facts: Facts) -> Reason:
        return facts.link_problem or facts.chunk_problem or because(Code.NOT_ENGAGED)

    def _begin_preparing(self, facts: Facts, timeout_ns: int) -> Move:
        self.phase = Phase.PREPARING
        self._own_mode = facts.mode if facts.armed else None
        self._preparation.begin(facts)
        self._prepare_timeout_ns, self._prepare_until_ns = timeout_ns, facts.now_ns + timeout_ns
        self._seen_interruptions = facts.interruptions
        self.starting_ns = None
        return self._prepare(facts, None)

    def _prepare(self, facts: Facts, act: Act | None) -> Move:
        if self._stop_reason is not None or act == "release":
            return self._depart(facts, self._stop_reason or Ending(reason=because(Code.OPERATOR)))
        is_first_mode = self._own_mode is None and self._preparation.wanted_mode(facts) is None
        if is_first_mode or self._preparation.is_own_mode(facts):
            self._own_mode = facts.mode
        taken = self._takeover(facts)
        if taken is None and self._was_ready and not facts.armed:
            taken = because(Code.DISARMED)
        if taken is not None:
            return self._yield(facts, taken)
        self._was_ready = facts.armed
        is_late = facts.now_ns > self._prepare_until_ns
        if is_late or self._preparation.impossibility(facts) is not None:
            return self._give_up_preparing(facts)
        # Once the policy is being reset, its silence is no reason to begin that anew.
        chunk_problem = facts.chunk_problem if self.starting_ns is None else None
        preparing = self._preparation.step(facts, self._objection(facts) or chunk_problem)
        self.reason = preparing.waits_for or because(Code.FIRST_CHUNK)
        if self._is_started(facts, is_ready=preparing.waits_for is None):
            return self._take_off(facts)
        return preparing.move

    def _is_started(self, facts: Facts, *, is_ready: bool) -> bool:
        """The policy was reset once all else was ready, and has solved since."""
        if not is_ready:
            self.starting_ns = None
        elif self.starting_ns is None:
            self.starting_ns = facts.now_ns
            until_ns = facts.now_ns + self._first_chunk_ns
            self._prepare_until_ns = max(self._prepare_until_ns, until_ns)
        return is_ready and facts.is_policy_reset and facts.chunk_problem is None

    def _give_up_preparing(self, facts: Facts) -> Move:
        """The vehicle, or an input, was not ready in time."""
        problem = self._preparation.impossibility(facts)
        if problem is None and self.starting_ns is not None:
            why = facts.chunk_problem or because(Code.NO_CHUNK)
            problem = because(Code.NO_CHUNK_SINCE_RESET, why=why)
        if problem is None:
            problem = because(
                Code.NOT_READY,
                after_s=self._prepare_timeout_ns / NS_PER_S,
                mode=facts.mode,
                is_armed=facts.armed,
                is_echoed=facts.echo_confirmed,
                inputs=facts.chunk_problem or "fine",
            )
        if self._prepare_timeout_ns == ACT_TIMEOUT_NS:  # the act may be repeated
            self.refusal = _not_engaged(problem)
            return self._depart(facts, Ending(reason=self.refusal, is_fault=True))
        self.failure = problem
        ending = Ending(reason=problem, is_fault=True)
        self.stop(ending)
        return self._depart(facts, ending)

    def _take_off(self, facts: Facts) -> Move:
        """The policy takes the sticks."""
        self.phase, self.starting_ns = Phase.FLYING, None
        flights = self.outcome.flights + 1
        self.outcome = self.outcome._replace(flights=flights, is_disarmed=False, end=None)
        self.reason = None
        self._own_mode = facts.mode
        self._seen_interruptions = facts.interruptions
        if self.engaged_ns is None:
            self.engaged_ns = facts.now_ns
        return Move(hand=Hand.POLICY)

    def _fly(self, facts: Facts, act: Act | None) -> Move:
        if facts.is_landed is not None and not self.outcome.has_left_ground:
            self.outcome = self.outcome._replace(has_left_ground=not facts.is_landed)
        if (taken := self._takeover(facts)) is not None:
            return self._yield(facts, taken)
        if (stop := self._stop_reason) is not None:
            return self._fail(facts, stop) if stop.is_fault else self._depart(facts, stop)
        if act == "release":
            return self._depart(facts, Ending(reason=because(Code.OPERATOR), end="operator"))
        if self._is_over(facts):
            over = Ending(reason=because(Code.DURATION), end="duration")
            self.stop(over)
            return self._depart(facts, over)
        if facts.landing is not None:
            return self._depart(facts, Ending(reason=facts.landing, end="landed"))
        fault = facts.link_problem or facts.chunk_fault or facts.envelope_problem
        if fault is not None:
            return self._fail(facts, Ending(reason=fault, is_fault=True))
        return Move(hand=Hand.POLICY)

    def _fail(self, facts: Facts, ending: Ending) -> Move:
        faults = self.outcome.faults + 1
        self.outcome = self.outcome._replace(faults=faults, fault=ending.reason)
        return self._depart(facts, ending)

    def _is_over(self, facts: Facts) -> bool:
        duration_ns = self._settings.duration_ns
        return (
            self.engaged_ns is not None
            and duration_ns is not None
            and facts.now_ns - self.engaged_ns >= duration_ns
        )

    def _takeover(self, facts: Facts) -> Reason | None:
        """Why the sticks are somebody else's now, or None."""
        if facts.interruptions != self._seen_interruptions:
            return facts.interruption
        if facts.overruled is not None:
            return facts.overruled
        if facts.is_switched_off:
            return because(Code.OVERRIDE_SWITCH_OFF)
        is_act = self.phase is Phase.PREPARING and self._prepare_timeout_ns == ACT_TIMEOUT_NS
        if self._switch.is_off and (self.phase is Phase.FLYING or is_act):
            return self._switch_off
        if not facts.armed and self.phase is not Phase.PREPARING:
            return because(Code.DISARMED)
        if facts.is_failsafe and facts.armed:
            return because(Code.FAILSAFE, mode=facts.mode)
        is_ours = facts.mode in (self._own_mode, self._departure.mode)
        if self._own_mode is not None and not is_ours and not self._departure.is_undone(facts):
            return because(Code.MODE_CHANGED, before=self._own_mode, after=facts.mode)
        return None

    def _follows_us(self, facts: Facts) -> bool:
        """It goes on with our last setpoint, in a mode of ours, and does nothing else."""
        is_left_alone = facts.overruled is None and not facts.is_failsafe
        is_own = self._preparation.is_own_mode(facts) or self.phase is not Phase.PREPARING
        return (
            (self._is_setpoint and facts.armed and is_left_alone)
            and (is_own and facts.mode == self._own_mode)
            and facts.mode in facts.modes.setpoint
        )

    def _yield(self, facts: Facts, reason: Reason) -> Move:
        """Somebody took over: sticks are given back, and a mode that follows setpoints is left.

        There silence would be the policy's last lean or body rate for one to three seconds.
        """
        if self.phase is Phase.FLYING:
            end: FlightEnd = "takeover" if facts.armed else "disarmed"
            self.outcome = self.outcome._replace(is_disarmed=not facts.armed, end=end)
        if not self._follows_us(facts):
            return self._give_back(facts, reason)
        self._seen_interruptions = facts.interruptions
        return self._depart(facts, Ending(reason=reason, is_fault=True))

    def _give_back(self, facts: Facts, reason: Reason | None) -> Move:
        """Release in this same step, and no mode command."""
        had_sticks = self.phase is not Phase.PREPARING or self._preparation.has_sticks
        self.phase, self.starting_ns = Phase.RELEASING, None
        self.reason = reason
        self._released_ns = facts.now_ns
        # At least once, also where nothing seems to be held: a reboot may be but a wrong stamp.
        return Move(hand=Hand.RELEASE) if had_sticks else self._release(facts)

    def _depart(self, facts: Facts, ending: Ending) -> Move:
        """Our own fault or end: neutral, a safe mode, then the release."""
        is_ours = (self._preparation.has_sticks and facts.armed) or self._follows_us(facts)
        if self.phase is Phase.PREPARING and not is_ours:
            return self._give_back(facts, ending.reason)  # we never had the sticks in the air
        if self.phase is Phase.FLYING and self.outcome.end is None:
            end = "fault" if ending.is_fault else ending.end
            self.outcome = self.outcome._replace(end=end)
        self.phase, self.starting_ns = Phase.LEAVING, None
        self.reason = ending.reason
        self._must_end = self._must_end and ending is not self._stop_reason
        self._departure.begin(facts, ending)
        self._heard_ns = facts.now_ns
        self.refusal, self._departure.note = self._departure.note or self.refusal, None
        return self._leave(facts, None)

    def _leave(self, facts: Facts, act: Act | None) -> Move:
        if self.phase is Phase.HOLDING and (act == "release" or self._must_end):
            # What held after a fault now ends as a flight without a fault does.
            return self._depart(facts, self._stop_reason or Ending(reason=because(Code.OPERATOR)))
        if self._unheard_ns is None:
            self._heard_ns = facts.now_ns
        taken = self._takeover(facts)
        if facts.now_ns - self._heard_ns >= LOST_NS:
            taken = taken or because(Code.VEHICLE_LOST, after_s=LOST_NS / NS_PER_S)
        if taken is not None:
            first = self.reason
            both = taken if first is None else because(Code.THEN, first=first, then=taken)
            return self._give_back(facts, both)
        if facts.mode == self._departure.mode:
            self._own_mode = facts.mode
        move = self._departure.step(facts, self._unheard_ns)
        if self._departure.is_done:
            if self.phase is Phase.LEAVING and self._departure.mode not in (None, facts.mode):
                mode = self._departure.mode or ""
                self.refusal = because(Code.MODE_NOT_CONFIRMED, mode=mode)
            if not self._departure.must_hold:
                return self._give_back(facts, self.reason)
            self.phase = Phase.HOLDING
        return move

    def _release(self, facts: Facts) -> Move:
        timeout_ns = RELEASE_TIMEOUT_NS if facts.shows_last else UNHEARD_RELEASE_TIMEOUT_NS
        if facts.is_released or facts.now_ns - self._released_ns >= timeout_ns:
            if not facts.is_released:
                self.refusal = because(Code.RELEASE_NOT_SEEN)
            self.phase = Phase.RELEASED
            self._departure.forget()
            return Move()
        return Move(hand=Hand.RELEASE)

    def _watch(self, facts: Facts) -> Move:
        """Read-only: the policy runs whenever it could fly, and the link sends nothing."""
        if self._stop_reason is not None or self._is_over(facts):
            self.phase = Phase.ENDED
            return Move()
        objection = self._objection(facts)
        if self.phase is Phase.FLYING or self.starting_ns is None:
            objection = objection or facts.chunk_problem
        if objection is not None:
            self.phase, self.reason = Phase.WAITING, objection
        if self.phase is Phase.FLYING:
            return Move(hand=Hand.POLICY)
        is_started = self._is_started(facts, is_ready=objection is None)
        return self._take_off(facts) if is_started else Move()

    # --- for the death of the guard

    def rehearse(self, facts: Facts) -> Iterator[tuple[int, Move]]:
        """Yield the moves, with their delays in ns, that end the flight if the guard dies now.

        A copy of this machine takes the death for a fault, and hears nothing more of the vehicle.
        """
        twin = deepcopy(self, {id(self._settings): self._settings})
        twin._departure.ask_at_once(facts.now_ns)
        if self.phase in (Phase.PREPARING, Phase.FLYING):
            twin.stop(Ending(reason=because(Code.GUARD_DIED), is_fault=True))
        # Sticks jump to neutral, unseen by us; the flight process says the words at once, or never.
        facts = replace(facts, are_sticks_at_rest=False, heard_ns=None, mode_ns=None)
        rest_ns = STICK_REST_NS if facts.modes.override else 0
        until_ns = rest_ns + _ASKED_NS
        for after_ns in (after_ms * NS_PER_MS for after_ms in _REHEARSED_MS):
            if after_ns > until_ns:
                break
            move = twin.step(replace(facts, now_ns=facts.now_ns + after_ns), None)
            if twin.phase not in (Phase.LEAVING, Phase.HOLDING):
                until_ns = after_ns
                break
            yield after_ns, move
        # The mode was asked for three times: it passes for confirmed.
        must_release = twin.phase is Phase.LEAVING and not twin._departure.is_silence_failsafe
        if twin.phase is Phase.RELEASING or must_release:
            for k in range(_RELEASES):
                yield until_ns + k * 50 * NS_PER_MS, Move(hand=Hand.RELEASE)


def _not_engaged(why: Reason) -> Reason:
    return because(Code.NOT_ENGAGED_SINCE, why=why)
