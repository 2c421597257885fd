"""Who controls the vehicle: the states, what happens in them, and what follows from it.

Rules that every row keeps:

1. Only an explicit act engages: ``--arm`` (once), the operator's key, the engage switch that goes
   high after a rest, the first arming with ``--engage-on-arm``. Nothing that recovers, comes back
   or is armed again does, and an act that no row follows is forgotten.
2. Who takes the vehicle wins over everything else that happens in the same step: the sticks are
   released in that step, and no mode is asked for.
3. What ends by our own doing is neutral in the same step, then in a safe mode, then released, and
   only to a hand that would hold it.
4. In WAITING, RELEASED and ENDED nothing is sent.

In each step the rows of the state are read from the top. The first one whose event happens and
whose condition holds is taken; one without a next state goes on to those below. ``TABLE`` is read
with what comes from outside, then the state acts (``CONTROLS``), then ``PROGRESS`` is read with
what its sequence has reached. The first lines of the docstrings are the texts of docs/SAFETY.md.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import FlightEnd
from mavbridge.guard.memory import Memory
from mavbridge.guard.values import EndRequest, EngagementInputs, Phase

WAITING, PREPARING, FLYING, LEAVING, HOLDING, RELEASING, RELEASED, ENDED = Phase
PREPARE_TIMEOUT_NS = 90 * NS_PER_S
"""For mode change and arming, without the climb; a cold estimator needs some 40 s."""
ACT_TIMEOUT_NS = 3 * NS_PER_S
"""For the change of mode that an act asks for while armed: no act comes true much later."""
RELEASE_TIMEOUT_NS = NS_PER_S
"""Wait for the vehicle to show other sticks than ours. Without a receiver it never does."""
UNHEARD_RELEASE_TIMEOUT_NS = 4 * NS_PER_S
"""The same where it does not even show the last ones that we sent, so that the releases may be lost
as well: longer than it holds ours on its own (RC_OVERRIDE_TIME, 3 s by default)."""
LOST_NS = 30 * NS_PER_S
"""A vehicle that was held for so long without a word from it is gone: nothing can be held."""


# --- events: pure, of what is remembered and what comes in


def engage_while_ending(m: Memory, _: EngagementInputs) -> Reason | None:
    """an act"""
    if m.act != "engage":
        return None
    return because(Code.STILL_ENDING, phase=m.phase.value)


def ended(m: Memory, now: EngagementInputs) -> bool:
    """the end: `--duration`, a signal, the death of the flight process"""
    return m.end_request is not None or duration_over(m, now) is not None


def arm_flag(m: Memory, now: EngagementInputs) -> bool:
    """`--arm`, once, as soon as the link is ready"""
    return m.wants_arm and now.link_problem is None


def unfit_engage(m: Memory, now: EngagementInputs) -> Reason | None:
    """an act, but disarmed, in a failsafe, outside the envelope, with the engage switch low, in a
    mode that is neither allowed nor ours to change, without link or fresh chunk"""
    if m.act != "engage":
        return None
    if not now.armed:
        return because(Code.NOT_ARMED)
    if (reason := objection(m, now) or now.chunk_problem) is not None:
        return reason
    modes = m.settings.engage.modes
    if m.engage.may_change_mode(now) or now.mode in modes:
        return None
    return because(Code.WRONG_MODE, mode=now.mode, allowed=" or ".join(modes))


def engage(m: Memory, _: EngagementInputs) -> bool:
    """an act: the key `e`, the engage switch, the first arming with `--engage-on-arm`"""
    return m.act == "engage"


def stopped(m: Memory, _: EngagementInputs) -> EndRequest | None:
    """the key `q`, a signal, the death or a fault of the flight process"""
    if m.end_request is None and m.act == "release":
        return EndRequest(because(Code.OPERATOR), end="operator")
    return m.end_request


def stopped_anew(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """the key `q`, or the first end after a fault"""
    return stopped(m, now) if m.must_stop or m.act == "release" else None


def taken(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """**takeover**: mode changed, disarmed, failsafe, override switch low, engage switch low (where
    the policy flies or an act is followed), other sticks than ours followed, reboot, another
    address, a parameter that matters changed"""
    if (reason := _takeover(m, now)) is None:
        return None
    return EndRequest(reason, is_fault=True, end="takeover" if now.armed else "disarmed")


def late(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """not ready in time: 90 s with `--arm`, and a second for each metre of `--takeoff`; 3 s after
    another act. Never ready: a mode that the vehicle lacks, a policy that is too slow"""
    problem = m.engage.impossibility(now)
    if problem is None and now.now_ns <= m.until_ns:
        return None
    if problem is None and m.starting_ns is not None:
        why = now.chunk_problem or because(Code.NO_CHUNK)
        problem = because(Code.NO_CHUNK_SINCE_RESET, why=why)
    if problem is None:
        problem = because(
            Code.NOT_READY,
            after_s=m.allowed_ns / NS_PER_S,
            mode=now.mode,
            is_armed=now.armed,
            is_echoed=now.echo_confirmed,
            inputs=now.chunk_problem or "fine",
        )
    return EndRequest(not_engaged(problem) if is_act(m) else problem, is_fault=True)


def duration_over(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """`--duration` is over"""
    duration_ns = m.settings.duration_ns
    if m.engaged_ns is None or duration_ns is None or now.now_ns - m.engaged_ns < duration_ns:
        return None
    return EndRequest(because(Code.DURATION), end="duration")


def landed(_: Memory, now: EngagementInputs) -> EndRequest | None:
    """landed"""
    return None if now.landing is None else EndRequest(now.landing, end="landed")


def fault(_: Memory, now: EngagementInputs) -> EndRequest | None:
    """**fault**: no usable chunk for longer than [the grace](#the-grace), no attitude from the
    vehicle for as long, 5 malformed chunks (NaN), envelope left, link lost, our packets refused by
    the system for 100 ms or our sticks not heard, a command that cannot be made"""
    reason = now.link_problem or now.chunk_fault or now.envelope_problem
    return None if reason is None else EndRequest(reason, is_fault=True)


def vanished(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """30 s without a word from the vehicle"""
    if now.now_ns - m.heard_ns < LOST_NS:
        return None
    return EndRequest(because(Code.VEHICLE_LOST, after_s=LOST_NS / NS_PER_S), is_fault=True)


def release_seen(m: Memory, now: EngagementInputs) -> bool:
    """the vehicle shows other sticks than ours"""
    return now.is_released and not m.owes_release


def release_unseen(m: Memory, now: EngagementInputs) -> Reason | None:
    """1 s over; 4 s where the vehicle does not even show our last sticks"""
    timeout_ns = RELEASE_TIMEOUT_NS if now.shows_last else UNHEARD_RELEASE_TIMEOUT_NS
    return because(Code.RELEASE_NOT_SEEN) if now.now_ns - m.released_ns >= timeout_ns else None


def ready(m: Memory, now: EngagementInputs) -> bool:
    """armed, in its mode, and the first chunk that was solved after a reset"""
    return m.engage.waits_for is None and now.is_policy_reset and now.chunk_problem is None


def unconfirmed(m: Memory, now: EngagementInputs) -> Reason | None:
    """the safe mode is not confirmed in time"""
    mode = m.disengage.mode
    if not m.disengage.is_done or mode in (None, now.mode):
        return None
    return because(Code.MODE_NOT_CONFIRMED, mode=mode or "")


def over(m: Memory, _: EngagementInputs) -> bool:
    """mode confirmed, after 50 ms of neutral at least; or not in 3 s, while the vehicle is heard"""
    return m.disengage.is_done


# --- conditions


def is_ours(m: Memory, now: EngagementInputs) -> bool:
    """armed by us or flown by our neutral sticks; or it follows our setpoints"""
    return (m.engage.has_sticks and now.armed) or follows_us(m, now)


def follows_us(m: Memory, now: EngagementInputs) -> bool:
    """it would go on with our last setpoint: still armed, in our mode, without a failsafe, and
    following nobody else"""
    is_own = m.phase is not Phase.PREPARING or m.engage.is_own_mode(now)
    return (
        (m.settings.engage.is_setpoint and now.armed and is_own)
        and (now.overruled is None and not now.is_failsafe)
        and (now.mode == m.own_mode and now.mode in now.modes.setpoint)
    )


def may_release(m: Memory, _: EngagementInputs) -> bool:
    """a hand would hold the vehicle, and silence is no failsafe; setpoints"""
    return not m.disengage.must_hold


# --- what is done


def nothing(_m: Memory, _now: EngagementInputs, _cause: object) -> None:
    """nothing"""


def refuse(m: Memory, _: EngagementInputs, why: Reason) -> None:
    """refused, and forgotten; says why"""
    m.refusal, m.act = not_engaged(why), None


def say(m: Memory, _: EngagementInputs, what: Reason) -> None:
    """says so"""
    m.refusal = what


def prepare(m: Memory, now: EngagementInputs, _cause: bool) -> None:
    """[the way in](#the-way-in); the policy is reset once all else is ready"""
    m.own_mode = now.mode if now.armed else None
    m.engage.begin(now)
    m.allowed_ns = ACT_TIMEOUT_NS
    if m.wants_arm:
        climb_s = m.settings.engage.takeoff_m or 0.0  # at 1 m/s; 1.5 m/s are usual
        m.allowed_ns = PREPARE_TIMEOUT_NS + round(climb_s * NS_PER_S)
    m.wants_arm = m.was_armed = False
    m.until_ns = now.now_ns + m.allowed_ns
    m.seen_interruptions = now.interruptions


def give_up(m: Memory, _: EngagementInputs, cause: EndRequest) -> None:
    """says why; the guard ends after `--arm`"""
    if is_act(m):
        m.refusal = cause.reason  # the act may be repeated
    else:
        m.failure = cause.reason
        m.end_request, m.must_stop = cause, True


def fly(m: Memory, now: EngagementInputs, _cause: bool) -> None:
    """the policy's sticks, from the pilot's or idle ones"""
    flights = m.outcome.flights + 1
    m.outcome = m.outcome._replace(flights=flights, is_disarmed=False, end=None)
    m.reason, m.own_mode, m.seen_interruptions = None, now.mode, now.interruptions
    m.engaged_ns = now.now_ns if m.engaged_ns is None else m.engaged_ns


def leave(m: Memory, now: EngagementInputs, cause: EndRequest) -> None:
    """neutral in the same step, then the mode of `--on-fault` after a fault or a takeover, of
    `--then` after an end: [the way out](#the-way-out)"""
    _note_end(m, cause)
    m.reason = cause.reason
    m.must_stop = m.must_stop and cause != m.end_request
    if cause.end in ("takeover", "disarmed"):
        m.seen_interruptions = now.interruptions
    m.refusal = m.disengage.begin(now, is_fault=cause.is_fault) or m.refusal
    m.heard_ns = now.now_ns


def leave_for_good(m: Memory, now: EngagementInputs, cause: EndRequest) -> None:
    """the same, and the guard ends"""
    m.end_request = cause
    leave(m, now, cause)


def release(m: Memory, now: EngagementInputs, cause: EndRequest) -> None:
    """**release in the same step, no mode**"""
    _note_end(m, cause)
    reason = cause.reason
    if m.phase in (Phase.LEAVING, Phase.HOLDING) and m.reason is not None:
        reason = because(Code.THEN, first=m.reason, then=reason)
    m.reason, m.released_ns = reason, now.now_ns
    m.owes_release = m.phase is not Phase.PREPARING or m.engage.has_sticks


def hand_over(m: Memory, now: EngagementInputs, _cause: bool) -> None:
    """release"""
    m.released_ns, m.owes_release = now.now_ns, True


def forget(m: Memory, _: EngagementInputs, cause: bool | Reason) -> None:
    """nothing"""
    m.disengage.mode = None  # from now on every mode change is somebody else's
    if isinstance(cause, Reason):
        m.refusal = cause


def _note_end(m: Memory, cause: EndRequest) -> None:
    """Note how a flight has ended, and whether by a fault of ours."""
    if m.phase is not FLYING:
        return
    is_fault = cause.is_fault and cause.end not in ("takeover", "disarmed")
    end: FlightEnd = "fault" if is_fault else cause.end
    m.outcome = m.outcome._replace(end=end, is_disarmed=end == "disarmed")
    if is_fault:
        m.outcome = m.outcome._replace(faults=m.outcome.faults + 1, fault=cause.reason)


def objection(m: Memory, now: EngagementInputs) -> Reason | None:
    """Return why the policy may not take the sticks of an armed vehicle now, or None."""
    if now.link_problem is not None:
        return now.link_problem
    if now.is_failsafe:
        return because(Code.FAILSAFE, mode=now.mode)
    if m.switch.is_off:
        return _switch_off(m)
    return now.envelope_problem


def is_act(m: Memory) -> bool:
    """True if the way in follows an act, and not ``--arm``."""
    return m.allowed_ns == ACT_TIMEOUT_NS


def not_engaged(why: Reason) -> Reason:
    """Reason for an act that has no effect."""
    return because(Code.NOT_ENGAGED_SINCE, why=why)


def _switch_off(m: Memory) -> Reason:
    return because(Code.ENGAGE_SWITCH_OFF, channel=m.settings.engage_channel or 0)


def _takeover(m: Memory, now: EngagementInputs) -> Reason | None:
    is_preparing = m.phase is Phase.PREPARING
    if now.interruptions != m.seen_interruptions:
        return now.interruption
    if now.overruled is not None:
        return now.overruled
    if now.is_switched_off:
        return because(Code.OVERRIDE_SWITCH_OFF)
    if m.switch.is_off and (m.phase is Phase.FLYING or (is_preparing and is_act(m))):
        return _switch_off(m)
    if not now.armed and not is_preparing:
        return because(Code.DISARMED)
    if now.is_failsafe and now.armed:
        return because(Code.FAILSAFE, mode=now.mode)
    is_ours = now.mode in (m.own_mode, m.disengage.mode) or m.disengage.is_undone(now)
    if m.own_mode is not None and not is_ours:
        return because(Code.MODE_CHANGED, before=m.own_mode, after=now.mode)
    return because(Code.DISARMED) if is_preparing and m.was_armed and not now.armed else None


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Row(Generic[T]):
    """One row: in these states, where this happens, that is done."""

    states: tuple[Phase, ...]
    event: Callable[[Memory, EngagementInputs], T | None]
    does: Callable[[Memory, EngagementInputs, T], None]
    next: Phase | None = None
    """None: the same, and the rows below are read."""
    where: Callable[[Memory, EngagementInputs], bool] | None = None

    def take(self, m: Memory, now: EngagementInputs) -> bool:
        """Do it if it happens; returns whether it did."""
        if not (cause := self.event(m, now)) or not (self.where is None or self.where(m, now)):
            return False
        self.does(m, now, cause)
        return True


TABLE = (
    Row((WAITING, RELEASED), ended, nothing, ENDED),
    Row((WAITING, RELEASED), arm_flag, prepare, PREPARING),
    Row((WAITING, RELEASED), unfit_engage, refuse),
    Row((WAITING, RELEASED), engage, prepare, PREPARING),
    Row((PREPARING,), stopped, leave, LEAVING, where=is_ours),
    Row((PREPARING,), stopped, release, RELEASING),
    Row((PREPARING, FLYING), taken, leave, LEAVING, where=follows_us),
    Row((PREPARING, FLYING), taken, release, RELEASING),
    Row((PREPARING,), late, give_up),
    Row((PREPARING,), late, leave, LEAVING, where=is_ours),
    Row((PREPARING,), late, release, RELEASING),
    Row((FLYING,), stopped, leave, LEAVING),
    Row((FLYING,), duration_over, leave_for_good, LEAVING),
    Row((FLYING,), landed, leave, LEAVING),
    Row((FLYING,), fault, leave, LEAVING),
    Row((LEAVING, HOLDING, RELEASING), engage_while_ending, refuse),
    Row((HOLDING,), stopped_anew, leave, LEAVING),
    Row((LEAVING, HOLDING), taken, release, RELEASING),
    Row((LEAVING, HOLDING), vanished, release, RELEASING),
    Row((RELEASING,), release_seen, forget, RELEASED),
    Row((RELEASING,), release_unseen, forget, RELEASED),
)
PROGRESS = (
    Row((PREPARING,), ready, fly, FLYING),
    Row((LEAVING,), unconfirmed, say),
    Row((LEAVING, HOLDING), over, hand_over, RELEASING, where=may_release),
    Row((LEAVING,), over, nothing, HOLDING),
)
