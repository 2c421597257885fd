"""State of the engagement, and the actions of its table's rows.

An "act" is an operator's engage command.
"""

from dataclasses import dataclass, field

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.switch import Switch
from mavbridge.guard.sequences import DisengageSequence, EngageSequence
from mavbridge.guard.values import (
    EndRequest,
    EngagementInputs,
    EngagementSettings,
    GuardOutcome,
    OperatorCommand,
    Phase,
)

PREPARE_TIMEOUT_NS = 90 * NS_PER_S
"""Time limit for mode change and arming, without the climb; a cold estimator needs some 40 s."""
ACT_TIMEOUT_NS = 3 * NS_PER_S
"""Time limit for the mode change after an act while armed: the act expires then."""
REST_NS = 1_800 * NS_PER_MS
"""Least time that the engage switch must rest low before going high is an act. Receivers that
dropped out for 0.6 to 1.5 s, with a preset that puts the switch low, have looked like a hand."""
LATE_NS = 1_500 * NS_PER_MS
"""Longest time from a request for a mode to the report of it: a heartbeat a second, and a radio."""


@dataclass(slots=True, kw_only=True)
class Memory:
    """State that persists between steps."""

    settings: EngagementSettings
    first_chunk_ns: int
    """Time limit for the policy's first chunk after its reset."""
    engage: EngageSequence
    disengage: DisengageSequence
    phase: Phase = Phase.WAITING
    reason: Reason | None = field(default_factory=lambda: because(Code.NOT_ENGAGED))
    """Why the policy does not fly; None while it does."""
    refusal: Reason | None = None
    """Failure of the last act, or missing confirmation by the vehicle; the reader resets it."""
    outcome: GuardOutcome = field(default_factory=GuardOutcome)
    act: OperatorCommand | None = None
    """Act of this step, from any source, until a row handles it."""
    end_request: EndRequest | None = None
    """First request to end: the guard ends after this flight."""
    must_stop: bool = False
    """True until ``end_request`` has been acted upon."""
    wants_arm: bool
    """True until ``--arm`` has been acted upon."""
    engaged_ns: int | None = None
    """Start of the first flight."""
    own_mode: str | None = None
    """Mode of our flight, present or requested and entered; any change of it is a takeover."""
    asked_ns: dict[str, int] = field(default_factory=dict)
    """Last request for each mode that has not been reported since."""
    seen_interruptions: int = 0
    is_extended: bool = False
    """True once the deadline of PREPARING was moved for the policy's first chunk."""
    was_armed: bool = False
    """True if the vehicle was armed at the last step of PREPARING."""
    starting_ns: int | None = None
    """Start of the policy's reset, when all else was ready; None before and after."""
    allowed_ns: int = 0
    """Time allowed for PREPARING."""
    until_ns: int = 0
    """Deadline of PREPARING."""
    released_ns: int = 0
    released_mode: str | None = None
    """Mode of ours in which the sticks were released; None if somebody or a failsafe changed it."""
    trusts_hand: bool = False
    """True if the release counts on the receiver's sticks to hold the vehicle."""
    owes_release: bool = False
    """True until a release has been sent; one is sent even if no sticks seem to be held."""
    stepped_ns: int | None = None
    unheard_ns: int | None = None
    """Last message of the vehicle before its silence or our stall; None: its mode is known."""
    news_from_ns: int = 0
    """Messages that arrived before this time date from before the silence."""
    heard_ns: int = 0
    """Last time at which the mode was known; reset when LEAVING begins."""
    is_arming_awaited: bool | None = None
    """True until the vehicle is armed for the first time; None until it is seen disarmed or armed,
    at first and after a silence."""
    heeds_switch: bool = False
    """True if a hand may still put the engage switch low, to end LEAVING and HOLDING."""
    switch: Switch = field(default_factory=lambda: Switch(rest_ns=REST_NS))

    @property
    def is_act(self) -> bool:
        """True if PREPARING follows an act, not ``--arm``."""
        return self.allowed_ns == ACT_TIMEOUT_NS

    def has_asked(self, now: EngagementInputs) -> bool:
        """True if the present mode is the late effect of a request of ours."""
        asked_ns = self.asked_ns.get(now.status.mode)
        return asked_ns is not None and now.now_ns - asked_ns <= LATE_NS

    def lost_mode(self, now: EngagementInputs) -> str | None:
        """Return the mode of the release if PX4 has fallen into the failsafe of sticks since, or a
        safe mode if the released sticks do not hold the vehicle.

        PX4 reads a resting receiver every 0.3 s and misses our sticks after 0.6 s, so that it may
        see neither for a moment. Its failsafe then ignores the pilot's sticks, and ends in RTL.
        """
        if now.status.mode == self.released_mode and self.unheld(now) is not None:
            return self.disengage.unheld_mode
        is_chosen = now.status.is_mode_chosen and now.status.mode != self.released_mode
        if (now.status.stick_loss_ns or 0) <= self.released_ns or is_chosen:
            return None  # a geofence, a battery, or a pilot who wants Hold
        is_dropped = now.status.is_failsafe and now.status.mode == now.link.modes.hold
        return self.released_mode if is_dropped and self.may_lose_mode(now) else None

    def may_lose_mode(self, now: EngagementInputs) -> bool:
        """True if PX4 may yet fall into that failsafe."""
        has_fallback = bool(now.link.modes.override) and not now.link.modes.is_silence_failsafe
        is_recent = now.now_ns - self.released_ns <= LATE_NS and not self.settings.is_setpoint
        return has_fallback and is_recent and now.status.armed and self.released_mode is not None

    def unheld(self, now: EngagementInputs) -> Reason | None:
        """Return why the released sticks do not hold the vehicle, if they were to hold it.

        They were moved during the flight, or had been the overrides of another station.
        """
        is_recent = now.now_ns - self.released_ns <= LATE_NS
        if not (self.trusts_hand and is_recent and now.link.is_released and now.status.armed):
            return None
        reason = self.disengage.hand_objection(now)
        return reason if reason is not None and reason.code is Code.THROTTLE_RESTS else None

    def nothing(self, _now: EngagementInputs, _cause: object) -> None:
        """nothing"""

    def refuse(self, _: EngagementInputs, why: Reason) -> None:
        """refused, with the reason"""
        self.refusal, self.act = not_engaged(why), None

    def tell(self, _: EngagementInputs, why: Reason) -> None:
        """warn: this mode may ignore the pilot's sticks"""
        self.refusal = why

    def call_off(self, now: EngagementInputs, _cause: bool) -> None:
        """`--arm` is called off"""
        self.refuse(now, because(Code.OPERATOR))
        self.wants_arm = False

    def prepare(self, now: EngagementInputs, _cause: bool) -> None:
        """[the way in](#the-way-in)"""
        self.own_mode = now.status.mode if now.status.armed else None
        self.engage.begin(now)
        self.allowed_ns = ACT_TIMEOUT_NS
        if self.wants_arm:
            climb_s = self.settings.takeoff_m or 0.0  # at 1 m/s; usual is 1.5 m/s
            self.allowed_ns = PREPARE_TIMEOUT_NS + round(climb_s * NS_PER_S)
        self.wants_arm = self.was_armed = self.is_extended = False
        self.until_ns = now.now_ns + self.allowed_ns
        self.seen_interruptions = now.link.interruptions

    def give_up(self, _: EngagementInputs, cause: EndRequest) -> None:
        """say why; after `--arm` the guard ends"""
        if self.is_act:
            self.refusal = cause.reason  # the act may be repeated
        else:
            self.outcome, self.end_request = self.outcome._replace(failure=cause.reason), cause

    def fly(self, now: EngagementInputs, _cause: object) -> None:
        """the policy's actions, starting from the pilot's or idle sticks"""
        self.outcome = self.outcome._replace(flights=self.outcome.flights + 1, end=None)
        self.reason, self.own_mode = None, now.status.mode
        self.seen_interruptions = now.link.interruptions
        self.engaged_ns = now.now_ns if self.engaged_ns is None else self.engaged_ns

    def leave(self, now: EngagementInputs, cause: EndRequest) -> None:
        """neutral, then a safe mode

        Neutral in the same step; then the mode of `--on-fault` after a fault or a takeover, that
        of `--then` after an end, or no other mode if a pilot gets the sticks: see [the way
        out](#the-way-out).
        """
        self._note_end(cause)
        self.reason = cause.reason
        self.must_stop = self.must_stop and cause != self.end_request
        if cause.end == "takeover":
            self.seen_interruptions = now.link.interruptions
        self.refusal = self.disengage.begin(now, is_planned=cause.is_planned) or self.refusal
        # PX4 ignores the transmitter's own switches until its receiver follows our sticks.
        has_fallback = bool(now.link.modes.override) and not self.disengage.is_silence_failsafe
        has_switch = self.settings.engage_channel is not None and not self.switch.is_off
        self.heeds_switch = has_fallback and has_switch and not self.settings.is_setpoint
        self.heard_ns = now.now_ns

    def leave_for_good(self, now: EngagementInputs, cause: EndRequest) -> None:
        """neutral, then a safe mode; the guard exits after that"""
        self.end_request = cause
        self.leave(now, cause)

    def release(self, now: EngagementInputs, cause: EndRequest) -> None:
        """**release at once**

        In the same step; no mode is requested.
        """
        self._note_end(cause)
        reason = cause.reason
        # On the ground a vehicle disarms itself for want of what the way in waits for.
        is_first = self.phase is not Phase.PREPARING or reason.code is Code.DISARMED
        if is_first and self.reason is not None:
            reason = because(Code.THEN, first=self.reason, then=reason)
        self.reason = reason
        self._note_release(now)
        self.trusts_hand = False
        self.owes_release = self.phase is not Phase.PREPARING or self.engage.has_sticks

    def finish(self, now: EngagementInputs, _cause: bool) -> None:
        """an unconfirmed mode is reported"""
        mode = self.disengage.mode
        if mode is not None and mode != now.status.mode:
            self.refusal = because(Code.MODE_NOT_CONFIRMED, mode=mode)
        self._note_release(now)
        self.trusts_hand = mode is None and self.disengage.may_release

    def forget(self, now: EngagementInputs, _cause: bool) -> None:
        """an unseen release is reported"""
        self.disengage.mode = None  # every later mode change comes from someone else
        if not now.link.is_released:
            self.refusal = because(Code.RELEASE_NOT_SEEN)

    def _note_release(self, now: EngagementInputs) -> None:
        self.released_ns = now.now_ns
        is_ours = now.status.mode == self.own_mode and not now.status.is_failsafe
        self.released_mode = now.status.mode if is_ours else None

    def _note_end(self, cause: EndRequest) -> None:
        """Note how a flight has ended."""
        if self.phase is Phase.FLYING:
            fault = cause.reason if cause.end == "fault" else self.outcome.fault
            self.outcome = self.outcome._replace(end=cause.end, fault=fault)


def not_engaged(why: Reason) -> Reason:
    """Return the reason for an act without effect."""
    return because(Code.NOT_ENGAGED_SINCE, why=why)
