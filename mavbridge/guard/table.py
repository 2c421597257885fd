"""State machine that decides who controls the vehicle: states, events and transitions.

Every row obeys these rules:

1. Only an explicit act engages the policy: ``--arm`` (once), the operator's key, the engage switch
   going high after a rest, or the first arming with ``--engage-on-arm``. A recovery, a return or a
   second arming never does, and an act that matches no row is discarded.
2. A takeover wins over every other event of the same step: the sticks are released in that step
   and no mode is requested. The one exception is a vehicle that would keep following our last
   setpoint: the policy leaves it as after a fault.
3. When we end the flight, the action is neutral in the same step; a safe mode follows, then the
   release, and only to a pilot or receiver that would hold the vehicle.
4. Nothing is sent in WAITING, RELEASED and ENDED.

Each step reads the rows of the present state from the top and takes the first one whose event has
occurred and whose condition holds. A row without a next state continues with the rows below it.
``TABLE`` is read first, for external events; then the state acts (``Engagement``); then
``PROGRESS`` is read, for what the state's sequence has completed. The docstrings below are the
texts of docs/safety.md.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.switch import GAP_NS
from mavbridge.guard.memory import Memory, not_engaged
from mavbridge.guard.values import EndRequest, EngagementInputs, Phase

WAITING, PREPARING, FLYING, LEAVING, HOLDING, RELEASING, RELEASED, ENDED = Phase
RELEASE_TIMEOUT_NS = NS_PER_S
"""Longest wait for the vehicle to show sticks other than ours. Without a receiver it never does."""
NOT_SET = (Code.SET_ABSENT, Code.SET_REFUSED, Code.SET_UNANSWERED)
"""Problems of a link that are over only after another start."""
LOST_NS = 30 * NS_PER_S
"""Silence of a held vehicle after which it counts as lost, and holding it ends; and longest wait if
it does not even show our last sticks, since it may not hear the releases either."""
UNSEEN_RELEASE_NS = 4 * NS_PER_S
"""That wait without a receiver: the vehicle's failsafe has acted by then, and its sticks stay."""
UNSEEN_NS = 2 * GAP_NS
"""Time without a reading after which the engage switch counts as dead: 20 periods of RC_CHANNELS at
the lowest requested rate."""


# --- events: pure functions of the memory and the inputs


def ended(m: Memory, now: EngagementInputs) -> bool:
    """the end

    `--duration` is over, a signal, the death of the flight process.
    """
    return m.end_request is not None or duration_over(m, now) is not None


def arm_flag(m: Memory, now: EngagementInputs) -> bool:
    """`--arm`

    Once, as soon as the link is ready.
    """
    return m.wants_arm and now.link.problem is None


def called_off(m: Memory, _: EngagementInputs) -> bool:
    """the key `q`, and `--arm` waits"""
    return m.wants_arm and m.act == "release"


def not_set(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """the vehicle did not take a `--set`, and `--arm` waits for it"""
    problem = now.link.problem
    if not m.wants_arm or problem is None or problem.code not in NOT_SET:
        return None
    return EndRequest(problem)


def unfit_engage(m: Memory, now: EngagementInputs) -> Reason | None:
    """an engage command that must be refused

    The vehicle is disarmed, in a failsafe or outside the envelope; the engage switch is low or
    unseen; the mode is not allowed and we may not change it; there is no link or no fresh chunk;
    or the last flight is still ending.
    """
    if m.act != "engage":
        return None
    if m.phase in (LEAVING, HOLDING, RELEASING):
        return because(Code.STILL_ENDING, phase=m.phase.value)
    if not now.status.armed:
        return because(Code.NOT_ARMED)
    if (reason := objection(m, now) or now.chunk_problem) is not None:
        return reason
    modes = m.settings.modes
    if m.engage.may_change_mode(now) or now.status.mode in modes:
        return None
    return because(Code.WRONG_MODE, mode=now.status.mode, allowed=" or ".join(modes))


def engage(m: Memory, _: EngagementInputs) -> bool:
    """an engage command

    The key `e`, the engage switch, the first arming with `--engage-on-arm`.
    """
    return m.act == "engage"


_KEY = EndRequest(because(Code.OPERATOR), end="operator")


def stopped(m: Memory, _: EngagementInputs) -> EndRequest | None:
    """a stop

    The key `q`, a signal, a flight process that failed or died, the last gate of `--gates`.
    """
    if m.act == "release" and not m.must_stop:
        return _KEY
    return m.end_request


def stopped_anew(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """the key `q`, or the first stop after a fault"""
    if m.act == "release":
        return _KEY
    request, roles = m.end_request, now.link.modes
    comes_down = m.disengage.mode in (roles.land, roles.rtl)
    if request is None or not m.must_stop or (comes_down and request.end == "fault"):
        return None  # a fault must not stop a landing or a return
    return request


def taken(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """**takeover**

    The mode was changed, and not by a request of ours that took effect within 1.5 s; the vehicle
    was armed in another mode, disarmed, rebooted, is in a failsafe that changes the mode (PX4: any)
    or follows other sticks (a resting receiver's: only while it hears ours); the override switch is
    low (setpoints ignore it); the engage switch is low (in flight or while engaging; PX4: while
    held); the vehicle is silent while another one uses its system id; or a relevant parameter was
    changed.
    """
    if (reason := _takeover(m, now)) is None:
        return None
    return EndRequest(reason, "takeover" if now.status.armed else "disarmed")


def late(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """not ready in time

    After 90 s with `--arm`, plus one second per metre of `--takeoff`; after 3 s with another engage
    command; at once if waiting cannot help: the vehicle lacks the mode or is in a failsafe, or the
    policy is too slow.
    """
    problem = m.engage.impossibility(now) or _failsafe(m, now, keeps_mode=True)
    if problem is None and now.now_ns <= m.until_ns:
        return None
    if problem is None and m.starting_ns is not None:
        why = now.chunk_problem or because(Code.NO_CHUNK)
        problem = because(Code.NO_CHUNK_SINCE_RESET, why=why)
    if problem is None and (problem := objection(m, now)) is None:
        problem = because(
            Code.NOT_READY,
            after_s=m.allowed_ns / NS_PER_S,
            mode=now.status.mode,
            is_armed=now.status.armed,
            is_echoed=now.link.echo_confirmed,
            inputs=now.chunk_problem or "fine",
        )
    return EndRequest(not_engaged(problem) if m.is_act else problem, "fault")


def duration_over(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """`--duration` is over"""
    duration_ns = m.settings.duration_ns
    if m.engaged_ns is None or duration_ns is None or now.now_ns - m.engaged_ns < duration_ns:
        return None
    return EndRequest(because(Code.DURATION), end="duration")


def landed(_: Memory, now: EngagementInputs) -> EndRequest | None:
    """landed"""
    return None if now.landing is None else EndRequest(now.landing, end="landed")


def fault(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """**fault**

    No usable chunk, or no attitude from the vehicle, for longer than [the grace](#the-grace); 5
    malformed chunks (NaN) in a second; the envelope was left; the link was lost; the system has
    refused our packets for 100 ms; the vehicle does not hear our sticks, sets its clock back or
    sends from another address; a command could not be encoded; the engage switch is unseen for 1 s;
    or ArduPilot keeps the mode in a failsafe.
    """
    problem = now.link.problem or now.command_fault or now.chunk_fault or now.envelope_problem
    reason = problem or _failsafe(m, now, keeps_mode=True) or switch_unseen(m, now)
    return None if reason is None else EndRequest(reason, "fault")


def vanished(m: Memory, now: EngagementInputs) -> EndRequest | None:
    """30 s of silence from the vehicle"""
    if now.now_ns - m.heard_ns < LOST_NS:
        return None
    return EndRequest(because(Code.VEHICLE_LOST, after_s=LOST_NS / NS_PER_S))


def released(m: Memory, now: EngagementInputs) -> bool:
    """the vehicle shows sticks other than ours, or 1 s has passed

    30 s with a receiver, else 4 s, if it does not even show our last sticks; the outcome then says
    that the release was not seen. For 1.5 s PX4's failsafe for lack of sticks is undone first.
    """
    is_own_mode = now.status.mode == m.released_mode
    if m.lost_mode(now) is not None or (is_own_mode and m.may_lose_mode(now)):
        return False
    if now.link.is_released and not m.owes_release:
        return True
    most_ns = LOST_NS if now.status.has_receiver else UNSEEN_RELEASE_NS
    is_lost = now.now_ns - min(m.released_ns, m.heard_ns) >= most_ns
    is_over = now.now_ns - m.released_ns >= RELEASE_TIMEOUT_NS
    return is_over and (now.link.shows_last or is_lost)


def ready(m: Memory, now: EngagementInputs) -> bool:
    """ready

    The vehicle is armed and in its mode, and the first chunk since the policy's reset has arrived.
    """
    return m.engage.waits_for is None and now.is_policy_reset and now.chunk_problem is None


def over(m: Memory, _: EngagementInputs) -> bool:
    """the disengage sequence is complete

    The mode is confirmed, after at least 50 ms of neutral; or it was not confirmed within 3 s in
    which the vehicle was heard.
    """
    return m.disengage.is_done


def entered_late(m: Memory, now: EngagementInputs) -> Reason | None:
    """the vehicle enters a mode of ours after all, within 1.5 s of the request"""
    is_other = now.status.mode != m.released_mode and not now.status.is_failsafe
    if not (is_other and m.has_asked(now)):
        return None
    if (why := m.unheld(now)) is not None:
        return because(Code.NOT_RELEASED, instead=now.status.mode, why=why)
    return because(Code.ENTERED_LATE, mode=now.status.mode)


# --- conditions


def is_ours(m: Memory, now: EngagementInputs) -> bool:
    """we hold the vehicle

    We have armed it, or it flies by our neutral sticks or setpoints.
    """
    return (m.engage.has_sticks and now.status.armed) or follows_us(m, now)


def follows_us(m: Memory, now: EngagementInputs) -> bool:
    """it would keep following our last setpoint

    It is still armed in a mode that follows setpoints, on PX4 without a failsafe, and follows no
    other source. Released, it would hold the last setpoint for up to 3 s, and sticks do nothing in
    that mode.
    """
    is_own = m.phase is not Phase.PREPARING or m.engage.is_own_mode(now)
    return (
        (m.settings.is_setpoint and now.status.armed and is_own)
        and (now.link.overruled is None and _failsafe(m, now, keeps_mode=False) is None)
        and (now.status.mode == m.own_mode and now.status.mode in now.link.modes.setpoint)
    )


def may_release(m: Memory, _: EngagementInputs) -> bool:
    """it may be released

    Sticks: a hand or safe mode holds it, silence is no failsafe. Setpoints: the safe mode is
    confirmed, or PX4.
    """
    return not m.disengage.must_hold


def objection(m: Memory, now: EngagementInputs) -> Reason | None:
    """Return why the policy may not take the sticks of an armed vehicle now, or None."""
    if now.link.problem is not None:
        return now.link.problem
    if now.status.is_failsafe:
        return because(Code.FAILSAFE, mode=now.status.mode)
    if m.switch.is_off:
        return _switch_off(m)
    return switch_unseen(m, now) or now.envelope_problem


def switch_unseen(m: Memory, now: EngagementInputs) -> Reason | None:
    """Return the reason if the engage switch could not take control away, or None."""
    channel, newest_ns = m.settings.engage_channel, m.switch.newest_ns
    if channel is None or (newest_ns is not None and now.now_ns - newest_ns <= UNSEEN_NS):
        return None
    return because(Code.ENGAGE_SWITCH_UNSEEN, channel=channel, limit_s=UNSEEN_NS / NS_PER_S)


def _switch_off(m: Memory) -> Reason:
    return because(Code.ENGAGE_SWITCH_OFF, channel=m.settings.engage_channel or 0)


def _is_mode_ours(m: Memory, now: EngagementInputs) -> bool:
    is_late = m.phase in (LEAVING, HOLDING) and m.has_asked(now)
    is_ours = now.status.mode in (m.own_mode, m.disengage.mode) or m.disengage.is_undone(now)
    return is_ours or is_late


def _failsafe(m: Memory, now: EngagementInputs, *, keeps_mode: bool) -> Reason | None:
    """Return why an armed vehicle is in a failsafe, or None.

    ``keeps_mode``: True asks for one that kept our mode, False for one that changed it. ArduPilot
    reports a failsafe together with the mode that it sets. PX4 may report it earlier, so that our
    mode tells nothing there.
    """
    is_kept = _is_mode_ours(m, now) and not now.link.modes.needs_setpoints_first
    if not (now.status.is_failsafe and now.status.armed) or is_kept is not keeps_mode:
        return None
    return because(Code.FAILSAFE, mode=now.status.mode)


def _takeover(m: Memory, now: EngagementInputs) -> Reason | None:
    is_preparing = m.phase is Phase.PREPARING
    if now.link.interruptions != m.seen_interruptions:
        return now.link.interruption
    if now.link.overruled is not None:
        return now.link.overruled
    if now.link.is_switched_off:
        return because(Code.OVERRIDE_SWITCH_OFF)
    if m.switch.is_off and (m.phase is FLYING or (is_preparing and m.is_act) or m.heeds_switch):
        return _switch_off(m)
    if not now.status.armed and not is_preparing:
        return because(Code.DISARMED)
    changed = None
    if m.own_mode is not None and not _is_mode_ours(m, now):
        changed = because(Code.MODE_CHANGED, before=m.own_mode, after=now.status.mode)
        roles = now.link.modes
        has_come_down = now.status.is_landed and m.own_mode in (roles.land, roles.rtl)
        if has_come_down and m.phase in (LEAVING, HOLDING) and roles.needs_setpoints_first:
            changed = because(Code.LANDED)  # PX4 shows this change 4 ms before its disarming
    if m.own_mode is None and now.status.armed:  # we arm in our own mode only
        allowed = " or ".join(m.settings.modes)
        changed = because(Code.WRONG_MODE, mode=now.status.mode, allowed=allowed)
    # The flag of a failsafe that kept our mode stays up, and does not tell who changes the mode.
    codes = m.reason.codes if m.phase in (LEAVING, HOLDING) and m.reason is not None else ()
    failsafe = None if Code.FAILSAFE in codes else _failsafe(m, now, keeps_mode=False)
    is_disarmed = m.was_armed and not now.status.armed
    return failsafe or changed or (because(Code.DISARMED) if is_disarmed else None)


class Transition(NamedTuple):
    """One transition: in these states, if this event occurs, do that."""

    states: tuple[Phase, ...]
    event: Callable[[Memory, EngagementInputs], EndRequest | Reason | bool | None]
    does: Callable[[Memory, EngagementInputs, Any], None]
    """Called with the event's result."""
    next: Phase | None = None
    """None: the state stays, and the rows below are read."""
    where: Callable[[Memory, EngagementInputs], bool] | None = None


AT_REST = (WAITING, RELEASED)
TABLE = (
    Transition(AT_REST, ended, Memory.nothing, ENDED),
    Transition((WAITING,), not_set, Memory.give_up, ENDED),
    Transition((WAITING,), called_off, Memory.call_off),
    Transition((WAITING,), arm_flag, Memory.prepare, PREPARING),
    Transition((*AT_REST, LEAVING, HOLDING, RELEASING), unfit_engage, Memory.refuse),
    Transition(AT_REST, engage, Memory.prepare, PREPARING),
    Transition((PREPARING,), stopped, Memory.leave, LEAVING, where=is_ours),
    Transition((PREPARING,), stopped, Memory.release, RELEASING),
    Transition((PREPARING, FLYING), taken, Memory.leave, LEAVING, where=follows_us),
    Transition((PREPARING, FLYING), taken, Memory.release, RELEASING),
    Transition((PREPARING,), late, Memory.give_up),
    Transition((PREPARING,), late, Memory.leave, LEAVING, where=is_ours),
    Transition((PREPARING,), late, Memory.release, RELEASING),
    Transition((FLYING,), stopped, Memory.leave, LEAVING),
    Transition((FLYING,), duration_over, Memory.leave_for_good, LEAVING),
    Transition((FLYING,), landed, Memory.leave, LEAVING),
    Transition((FLYING,), fault, Memory.leave, LEAVING),
    Transition((HOLDING,), stopped_anew, Memory.leave, LEAVING),
    Transition((LEAVING, HOLDING), taken, Memory.release, RELEASING),
    Transition((LEAVING, HOLDING), vanished, Memory.release, RELEASING),
    Transition((RELEASING,), released, Memory.forget, RELEASED),
)
PROGRESS = (
    Transition((RELEASING, RELEASED), entered_late, Memory.tell),
    Transition((PREPARING,), ready, Memory.fly, FLYING),
    Transition((LEAVING, HOLDING), over, Memory.finish, RELEASING, where=may_release),
    Transition((LEAVING,), over, Memory.finish, HOLDING),
)
