"""Guard without I/O: maps the state of the link and the policy to stick commands.

The guard process, the simulation and the tests share this class. It never blocks: every wait is a
state, and the caller steps it at every arrival and at ``next_ns``.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, Reason
from mavbridge.core.ticks import GuardTick
from mavbridge.core.vehicle import (
    Action,
    ActionTrace,
    Decision,
    LinkSnapshot,
    Reading,
    Release,
    Sticks,
)
from mavbridge.guard.chunks import Chunk, ChunkBuffer, late
from mavbridge.guard.engagement import Engagement
from mavbridge.guard.envelope import Envelope
from mavbridge.guard.limits import ActionSmoother, first_action, idle_action, neutral_action
from mavbridge.guard.table import switch_unseen
from mavbridge.guard.values import (
    ControlSource,
    EndRequest,
    EngagementInputs,
    EngagementOutput,
    FlightSettings,
    OperatorCommand,
    Phase,
    StickGrid,
)

PILOT_FRESH_NS = 500 * NS_PER_MS
"""Oldest RC_CHANNELS that still tells the position of the pilot's sticks."""
STOOD_STILL_NS = 60 * NS_PER_MS
"""Time between two steps that means a stall of the guard; longer than the slowest stick period."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardInput:
    """News since the last step."""

    link: LinkSnapshot
    chunk: Chunk | None = None
    absence: Reason | None = None
    """Why the flight process cannot compute a chunk."""
    act: OperatorCommand | None = None
    stop: EndRequest | None = None
    command_fault: Reason | None = None
    """Error while the last command was encoded or sent."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardOutput:
    """Actions to take now, in this order: sticks, requests, messages."""

    decision: Decision | None
    """None: send nothing now."""
    actions: EngagementOutput
    """Requests to the vehicle."""
    messages: tuple[str, ...]
    """Texts for the user."""
    tick: GuardTick
    """Report of the step. The loop adds what was sent, and when it woke and sent."""


class Guard:
    """Decides which sticks are sent, and when."""

    def __init__(self, settings: FlightSettings, now_ns: int) -> None:
        self.settings = settings
        self._chunks = ChunkBuffer(
            settings.freshness, period_ns=settings.chunk_period_ns, kind=settings.meaning.kind
        )
        self._neutral, self._idle = neutral_action(settings.meaning), idle_action(settings.meaning)
        self._smoother = ActionSmoother(settings.smoothing, self._neutral)
        self._lead_ns = round(settings.smoothing.tau_s * NS_PER_S)
        """Lead for sampling a chunk, at most to its end; compensates the low-pass lag."""
        self._envelope = Envelope(settings.envelope)
        self.engagement = Engagement(settings.engagement, chunk_period_ns=settings.chunk_period_ns)
        self._grid = StickGrid(settings.stick_period_ns, now_ns)
        self._stepped_ns = self._heard_ns = now_ns
        """``_stepped_ns``: last step. ``_heard_ns``: end of the last stall, from which silence of
        the vehicle counts."""
        self._control: ControlSource | None = None
        self._seen: EngagementInputs | None = None
        """Inputs of the last step."""
        self._last = self._neutral
        """Last action sent."""
        self._before = self._smoother.state, self._last
        """Both before the last decision."""
        self._messages: list[str] = []

    @property
    def next_ns(self) -> int:
        """Latest time of the next step: the next slot."""
        return self._grid.next_ns

    @property
    def ways_out(self) -> str:
        """Acts that end the neutral sticks of HOLDING, in words."""
        # PX4 ignores the transmitter's own switches while our sticks flow.
        seen, engagement = self._seen, self.engagement
        place = " by a ground station" if seen is not None and seen.link.modes.override else ""
        is_heeded = engagement.heeds_switch and seen and switch_unseen(engagement, seen) is None
        switch = ", or put the engage switch low" if is_heeded else ""
        return f"you disarm or change the mode{place}{switch}"

    def rehearse(self) -> Iterator[tuple[int, Decision | None, str | None]]:
        """Yield delay [ns], decision and requested mode of each last word, if the guard dies."""
        if self._seen is None:
            return
        for after_ns, actions in self.engagement.rehearse(self._seen):
            yield after_ns, self._at_rest(actions.control), actions.mode

    def unsent(self) -> None:
        """Discard the last decision, which was not sent; continue from the one before, without a
        jump for the time that has passed. A read-only flight goes on as if it were sent."""
        if not self.settings.engagement.readonly:
            tried_ns, (state, self._last) = self._smoother.state.stepped_ns, self._before
            self._smoother.state = state._replace(stepped_ns=tried_ns)
            self._grid.unserve()

    def step(self, now_ns: int, given: GuardInput) -> GuardOutput:
        """Advance to ``now_ns`` with the given news; return the actions to take."""
        # Before the new chunk is taken: a stall of the guard itself may have ended the grace.
        stood_ns, self._stepped_ns = now_ns - self._stepped_ns, now_ns
        seen = given.link.telemetry
        overdue = self._chunks.lateness(now_ns, stood_ns=stood_ns, seen=seen, arriving=given.chunk)
        has_news = given.chunk is not None and self._chunks.offer(given.chunk, now_ns)
        if given.absence is not None:
            self._chunks.explain_absence(given.absence, now_ns)
        if given.stop is not None:
            self.engagement.stop(given.stop)
        phase_before = self.engagement.phase
        silence = self._silence(now_ns, stood_ns, seen.ned_from_body_wxyz)
        inputs = self._seen = self._inputs(now_ns, given, overdue or silence)
        actions = self.engagement.step(inputs, given.act)
        self._change_control(actions.control, now_ns, given.link)
        phase = self.engagement.phase
        # Skip a slot that was just served; send a new chunk and a change of phase at once.
        slot = self._grid.take(now_ns)
        is_urgent = phase is not phase_before or (
            has_news and actions.control is ControlSource.POLICY
        )
        decision, trace = None, None
        if slot is not None or is_urgent:
            self._grid.serve(now_ns)
            is_thrust = inputs.status.mode in given.link.modes.thrust
            self._before = self._smoother.state, self._last
            decision, trace = self._decide(actions.control, now_ns, is_thrust=is_thrust)
        newest = self._chunks.newest
        tick = GuardTick(
            index=slot.index if slot else -1,
            is_slot=slot is not None,
            due_ns=slot.due_ns if slot else now_ns,
            woke_ns=now_ns,
            decided_ns=now_ns,
            sent_ns=now_ns,
            missed_slots=slot.missed if slot else 0,
            is_coasting=trace is not None and self._chunks.is_coasting(now_ns),
            chunk_serial=newest.serial if trace is not None and newest is not None else None,
            trace=trace,
            sent=None,
            phase=phase,
            release_reason=self.engagement.reason,
            starting_ns=self.engagement.starting_ns or 0,
            end=self.engagement.outcome.end,
        )
        return GuardOutput(
            decision=decision, actions=actions, messages=self._take_messages(), tick=tick
        )

    def _silence(self, now_ns: int, stood_ns: int, attitude: Reading | None) -> Reason | None:
        """Return why a silent link ends the flight, or None: a chunk bridges a stall
        of this computer, not a silent vehicle."""
        if stood_ns > STOOD_STILL_NS:
            self._heard_ns = now_ns
        limit_ns = self._chunks.grace_ns
        if attitude is None or now_ns - max(self._heard_ns, attitude.arrived_ns) <= limit_ns:
            return None
        age_ns = now_ns - attitude.arrived_ns
        return late("attitude", age_ns, limit_ns, "link", age_ns)

    def _inputs(self, now_ns: int, given: GuardInput, overdue: Reason | None) -> EngagementInputs:
        link, status = given.link, given.link.status
        # These block only an engagement, so they are skipped in flight. A read-only flight is only
        # shown as FLYING, so they are always checked there.
        is_flying = self.engagement.phase is Phase.FLYING
        is_sought = not is_flying or self.settings.engagement.readonly
        starting_ns, newest = self.engagement.starting_ns, self._chunks.newest
        reset_ns = 0 if newest is None else newest.reset_ns
        left: Reason | None = None
        if status is not None:
            left = self._envelope.check(now_ns, link.telemetry, status)
        has_landed = left is not None and left.code is Code.LANDED
        return EngagementInputs(
            now_ns=now_ns,
            link=link,
            heard_ns=_newest(link),
            chunk_problem=self._chunks.problem(now_ns) if is_sought else None,
            chunk_fault=overdue or self._chunks.fault(now_ns),
            command_fault=given.command_fault,
            slowness=self._chunks.impossibility if is_sought else None,
            is_policy_reset=reset_ns >= (now_ns if starting_ns is None else starting_ns),
            envelope_problem=None if has_landed else left,
            landing=left if has_landed else None,
        )

    def _change_control(
        self, control: ControlSource | None, now_ns: int, link: LinkSnapshot
    ) -> None:
        """When policy or neutral takes control, start the filter from the current command."""
        before, self._control = self._control, control
        if control is ControlSource.NEUTRAL and before not in (control, ControlSource.POLICY):
            on_ground = before is ControlSource.IDLE
            start = self._idle if on_ground else self._first(link, None)
            self._smoother.reset(start)  # discard the state of an earlier flight
        if control is not ControlSource.POLICY or before is ControlSource.POLICY:
            return
        self._envelope.reset()
        self._messages += self._envelope.unwatched
        status = link.status
        if before is ControlSource.IDLE:
            self._smoother.reset(self._idle)
            return
        pilot: Sticks | None = None
        if status is not None and status.rc_arrived_ns is not None:
            is_fresh = now_ns - status.rc_arrived_ns <= PILOT_FRESH_NS
            pilot = status.pilot_sticks if is_fresh and before is None else None
        self._smoother.reset(self._first(link, pilot))

    def _first(self, link: LinkSnapshot, pilot: Sticks | None) -> Action:
        """Return the vehicle's current command, a velocity clipped to its limits.

        A wrong velocity would last long: at 5 m/s^2 the way back from 100 m/s takes 20 s.
        """
        meaning = self.settings.meaning
        first = first_action(meaning, link.telemetry, pilot)
        return self._smoother.limits.clip(first) if meaning.kind == "velocity" else first

    def _decide(
        self, control: ControlSource | None, now_ns: int, *, is_thrust: bool
    ) -> tuple[Decision | None, ActionTrace | None]:
        """Return the decision to send now; for an action of the policy also its trace.

        ``is_thrust``: the throttle stick is thrust in the present mode.
        """
        kind = self.settings.meaning.kind
        if control is not ControlSource.POLICY:
            decision = self._at_rest(control)
            if not isinstance(decision, Release | None):
                if kind == "velocity" and control is ControlSource.NEUTRAL:
                    # Brake within the limits.
                    decision = self._smoother.step(self._neutral, now_ns).smoothed
                self._last = decision
            return decision, None
        raw = self._chunks.action_at(now_ns, self._lead_ns)
        # Beyond the horizon, level sticks bridge the rest of the grace.
        level = self._level(is_thrust=is_thrust)
        if raw is None and kind == "rates":  # level is an attitude then: no filter
            trace = ActionTrace(raw=level, clipped=level, slewed=level, smoothed=level)
        else:
            trace = self._smoother.step(raw or level, now_ns)
            self._last = trace.smoothed
        return trace.smoothed, trace

    def _at_rest(self, control: ControlSource | None) -> Decision | None:
        """Return the decision of a source other than the policy, without side effects."""
        if control is None:
            return None
        if control is ControlSource.RELEASE:
            return Release()
        resting = {ControlSource.IDLE: self._idle, ControlSource.NEUTRAL: self._neutral}
        return resting.get(control) or self._level(is_thrust=True)

    def _level(self, *, is_thrust: bool) -> Action:
        """Return neutral, with the last throttle if the throttle stick is thrust."""
        neutral, last = self._neutral, self._last
        if isinstance(neutral, Sticks) and isinstance(last, Sticks) and is_thrust:
            return neutral._replace(throttle=last.throttle)
        return neutral

    def _take_messages(self) -> tuple[str, ...]:
        refusal, self.engagement.refusal = self.engagement.refusal, None
        if refusal is not None:
            self._messages.append(str(refusal))
        messages, self._messages = tuple(self._messages), []
        return messages


def _newest(link: LinkSnapshot) -> int | None:
    """Return the newest arrival of a mode, RC_CHANNELS or an attitude; None before the first."""
    status, attitude = link.status, link.telemetry.ned_from_body_wxyz
    stamps = (status.mode_arrived_ns, status.channels_arrived_ns) if status else ()
    arrivals = [stamp for stamp in (*stamps, attitude and attitude.arrived_ns) if stamp is not None]
    return max(arrivals, default=None)
