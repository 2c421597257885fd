"""State machine of the engagement: reads the table, and runs the sequences of its states."""

from collections.abc import Iterator, Sequence
from copy import deepcopy
from dataclasses import replace

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.guard.memory import ACT_TIMEOUT_NS, REST_NS, Memory, not_engaged
from mavbridge.guard.sequences import (
    MODE_SPACING_NS,
    STICK_REST_NS,
    DisengageSequence,
    EngageSequence,
)
from mavbridge.guard.table import (
    PROGRESS,
    TABLE,
    Transition,
    duration_over,
    objection,
    switch_unseen,
)
from mavbridge.guard.values import (
    ControlSource,
    EndRequest,
    EngagementInputs,
    EngagementOutput,
    EngagementSettings,
    OperatorCommand,
    Phase,
)

_REHEARSED_MS = (0, 20, 40, *range(100, 2000, 50))
"""Times after the guard's death at which its last words are sent [ms]. The first are close
together, since a packet that the guard sent in part swallows the next one."""
_ASKED_NS = 250 * NS_PER_MS
"""Time for which the last words request a mode; longer could undo the pilot's mode change."""
_RELEASES = 5
SILENCE_NS = 250 * NS_PER_MS
"""Silence of the vehicle, or stall of the guard, after which the vehicle's mode is unknown until
the next report: its failsafe may have acted, after 0.5 s at the earliest."""
BACKLOG_NS = 50 * NS_PER_MS
"""Time after a stall in which old data still comes out of pipes and sockets."""


class Engagement(Memory):
    """Decides who controls the vehicle; ``step`` runs whenever the guard wakes up."""

    def __init__(self, settings: EngagementSettings, *, chunk_period_ns: int = 0) -> None:
        """``chunk_period_ns``: time between chunks; the first after a reset may take two."""
        super().__init__(
            settings=settings,
            first_chunk_ns=ACT_TIMEOUT_NS + 2 * chunk_period_ns,
            engage=EngageSequence(settings),
            disengage=DisengageSequence(settings),
            wants_arm=settings.arm,
        )

    def stop(self, request: EndRequest) -> None:
        """Give the sticks back as the request demands, then enter ``ENDED``; the first counts."""
        # Our own request, after a start that failed, gives way to another one.
        if self.end_request is None or self.end_request.reason is self.outcome.failure:
            self.end_request, self.must_stop = request, True

    def step(self, now: EngagementInputs, act: OperatorCommand | None) -> EngagementOutput:
        """Advance to ``now`` with the operator's command, if any; return the actions to take."""
        if self.settings.readonly:
            return self._watch(now)
        self._listen(now)
        self._note_act(now, act)
        if self.phase is Phase.FLYING and now.status.is_landed is not None:
            has_left = self.outcome.has_left_ground or not now.status.is_landed
            self.outcome = self.outcome._replace(has_left_ground=has_left)
        while True:
            if self.phase is Phase.PREPARING:
                self._note_own_mode(now)
            begun = self._read(TABLE, now)
            if begun not in (Phase.PREPARING, Phase.LEAVING, Phase.RELEASING):
                break  # the others act in the step in which they begin
        actions = self._control(now)
        begun = self._read(PROGRESS, now)
        self.asked_ns.pop(now.status.mode, None)
        if actions.mode is not None:
            self.asked_ns[actions.mode] = now.now_ns
        return self._control(now) if begun in (Phase.FLYING, Phase.RELEASING) else actions

    def _read(self, rows: Sequence[Transition], now: EngagementInputs) -> Phase | None:
        """Execute the first matching row; return the state that begins, or None."""
        for row in rows:
            if self.phase not in row.states or not (cause := row.event(self, now)):
                continue
            if row.where is not None and not row.where(self, now):
                continue
            row.does(self, now, cause)
            if row.next is not None:
                self.phase, self.act, self.starting_ns = row.next, None, None
                return row.next
        return None

    def _control(self, now: EngagementInputs) -> EngagementOutput:
        """Return the actions of the current state."""
        match self.phase:
            case Phase.PREPARING:
                return self._prepare(now)
            case Phase.FLYING:
                return EngagementOutput(control=ControlSource.POLICY)
            case Phase.LEAVING | Phase.HOLDING:
                if now.status.mode == self.disengage.mode or self.has_asked(now):
                    self.own_mode = now.status.mode
                return self.disengage.step(now, self.unheard_ns)
            case Phase.RELEASING:
                self.owes_release = False
                is_due = now.now_ns >= self.disengage.request_due_ns
                mode = self.lost_mode(now) if is_due else None
                if mode is not None:
                    self.disengage.request_due_ns = now.now_ns + MODE_SPACING_NS
                return EngagementOutput(control=ControlSource.RELEASE, mode=mode)
            case Phase.WAITING:
                problem = now.link.problem or now.chunk_problem or switch_unseen(self, now)
                self.reason = problem or because(Code.NOT_ENGAGED)
        return EngagementOutput()

    def _prepare(self, now: EngagementInputs) -> EngagementOutput:
        self.was_armed = now.status.armed
        # During the policy's reset, its silence must not restart the reset.
        chunk_problem = now.chunk_problem if self.starting_ns is None else None
        actions = self.engage.step(now, objection(self, now) or chunk_problem)
        self.reason = self.engage.waits_for or because(Code.FIRST_CHUNK)
        self._start(now, is_ready=self.engage.waits_for is None)
        return actions

    def _start(self, now: EngagementInputs, *, is_ready: bool) -> None:
        """Request a reset of the policy once everything else is ready."""
        if not is_ready:
            self.starting_ns = None
        elif self.starting_ns is None:
            self.starting_ns = now.now_ns
            if not self.is_extended:  # once: readiness that comes and goes must not last for ever
                self.until_ns = max(self.until_ns, now.now_ns + self.first_chunk_ns)
            self.is_extended = True

    def _watch(self, now: EngagementInputs) -> EngagementOutput:
        """Read-only: run the policy whenever it could fly; the link sends nothing."""
        if (cause := self.end_request or duration_over(self, now)) is not None:
            if self.outcome.flights:
                self.phase = Phase.FLYING  # also if the policy could not fly at the end
            self._note_end(cause)
            self.phase, self.reason = Phase.ENDED, cause.reason
            return EngagementOutput()
        problem = objection(self, now)
        if self.starting_ns is None:
            problem = problem or now.chunk_problem
        if problem is not None:
            self.phase, self.reason = Phase.WAITING, problem
        if self.phase is not Phase.FLYING:
            self._start(now, is_ready=problem is None)
            if self.starting_ns is None or not now.is_policy_reset or now.chunk_problem is not None:
                return EngagementOutput()
            self.fly(now, None)
            self.phase, self.starting_ns = Phase.FLYING, None
        return EngagementOutput(control=ControlSource.POLICY)

    # --- inputs noted before the table is read

    def _listen(self, now: EngagementInputs) -> None:
        """Update whether the reported mode is current."""
        now_ns, stepped_ns = now.now_ns, self.stepped_ns
        heard_ns = now_ns if now.heard_ns is None else now.heard_ns
        mode_ns = now_ns if now.status.mode_arrived_ns is None else now.status.mode_arrived_ns
        self.stepped_ns = now_ns
        stood_still = stepped_ns is not None and now_ns - stepped_ns > SILENCE_NS
        if stood_still or now_ns - heard_ns > SILENCE_NS:
            if self.unheard_ns is None:
                self.unheard_ns = heard_ns if stepped_ns is None else min(heard_ns, stepped_ns)
            self.news_from_ns = now_ns + (BACKLOG_NS if stood_still else 0)
        elif mode_ns > self.news_from_ns:
            self.unheard_ns = None
        if self.unheard_ns is None:
            self.heard_ns = now_ns

    def _note_own_mode(self, now: EngagementInputs) -> None:
        """Treat the present mode as ours if we wait for no other, or requested it."""
        is_first = self.own_mode is None and self.engage.wanted_mode(now) is None
        if is_first or self.engage.is_own_mode(now):
            self.own_mode = now.status.mode

    def _note_act(self, now: EngagementInputs, act: OperatorCommand | None) -> None:
        """Note this step's act: the operator's command, the engage switch or the first arming."""
        is_armed_first = self._is_armed_first(now) and self.settings.engage_on_arm
        is_act = self._is_switched_on(now) or is_armed_first
        self.act = act or ("engage" if is_act else None)
        if self.act == "engage":
            self.refusal = None  # of another source's act in this step

    def _is_armed_first(self, now: EngagementInputs) -> bool:
        """True if a vehicle that was seen disarmed is seen armed for the first time.

        An arming during a silence is no act: the return of a link must not engage.
        """
        told_ns = now.now_ns if now.status.armed_arrived_ns is None else now.status.armed_arrived_ns
        oldest_ns = max(self.news_from_ns, now.now_ns - ACT_TIMEOUT_NS)
        was_awaited = self.is_arming_awaited
        if now.link.status is None or told_ns <= oldest_ns:
            self.is_arming_awaited = None if was_awaited else was_awaited
            return False
        if was_awaited is not False:
            self.is_arming_awaited = not now.status.armed
        if now.status.armed and was_awaited is None and self.settings.engage_on_arm:
            self.refusal = not_engaged(because(Code.ARMED_UNSEEN))
        return now.status.armed and was_awaited is True

    def _is_switched_on(self, now: EngagementInputs) -> bool:
        """True if a hand has put the engage switch high.

        Low takes the sticks back at once, even if a sick receiver reports it; an act needs a
        healthy receiver.
        """
        channel = self.settings.engage_channel
        if channel is None or len(now.status.rc_channels_us) < channel:
            return False
        arrived_ns = now.status.channels_arrived_ns or now.now_ns
        was_off = self.switch.is_off
        is_act = self.switch.read(now.status.rc_channels_us[channel - 1], arrived_ns)
        if now.status.is_failsafe or now.status.is_receiver_sick:
            self.switch.forget()
            is_act = False
        if was_off and not self.switch.is_off and not is_act:
            rest_s = REST_NS / NS_PER_S
            why = because(Code.SWITCH_NOT_RESTED, channel=channel, rest_s=rest_s)
            self.refusal = not_engaged(why)
        return is_act

    # --- last words

    def rehearse(self, now: EngagementInputs) -> Iterator[tuple[int, EngagementOutput]]:
        """Yield the actions that end the flight if the guard dies now, with their delays [ns].

        A copy of this state machine treats the death as a fault; it hears nothing of the vehicle.
        """
        twin = deepcopy(self, {id(self.settings): self.settings})
        twin.disengage.ask_at_once(now.now_ns)
        if self.phase in (Phase.PREPARING, Phase.FLYING):
            twin.stop(EndRequest(because(Code.GUARD_DIED), end="fault"))
        # Sticks jump to neutral unseen; the flight process sends the words at once, or never.
        status = replace(now.status, mode_arrived_ns=None)
        link = replace(now.link, status=status, are_sticks_at_rest=False)
        now = replace(now, link=link, heard_ns=None)
        rests = bool(now.link.modes.override) and not self.settings.is_setpoint
        until_ns = _ASKED_NS + (STICK_REST_NS if rests else 0)
        for after_ns in (after_ms * NS_PER_MS for after_ms in _REHEARSED_MS):
            if after_ns > until_ns:
                break
            actions = twin.step(replace(now, now_ns=now.now_ns + after_ns), None)
            if twin.phase not in (Phase.LEAVING, Phase.HOLDING):
                until_ns = after_ns
                break
            yield after_ns, actions
        # The mode has been requested three times by now: treat it as confirmed.
        must_release = twin.phase is Phase.LEAVING and not twin.disengage.is_silence_failsafe
        if twin.phase is Phase.RELEASING or must_release:
            for k in range(_RELEASES):
                yield until_ns + k * 50 * NS_PER_MS, EngagementOutput(control=ControlSource.RELEASE)
