"""Outcome of a flight: the facts, the line that states them, and the exit status."""

import logging
import math
import shlex
from collections.abc import Sequence
from pathlib import Path

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.course import CourseGate, CourseProgress
from mavbridge.core.errors import ExitCode
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import Event, FlightOutcome, Tick
from mavbridge.core.stopping import StopRequest
from mavbridge.core.vehicle import FlightEnd
from mavbridge.guard.values import EndRequest, GuardOutcome, Phase
from mavbridge.guard.wire import GuardStatus, GuardSummary
from mavbridge.recording.crash import CrashWatch

_log = logging.getLogger(__name__)
RUN_OUT_NS = NS_PER_S
"""Time from the last gate to the end of the flight, in which a crash still counts."""
MAX_RUN_OUT_NS = 10 * NS_PER_S
"""Longest such time of a policy that stops after the last gate."""
STILL_MPS, MOVED_MPS = 0.6, 1.5
"""Speeds below which a vehicle stands still, and above which it has flown."""
STILL_NS = 3 * NS_PER_S // 2
"""Time of standing still that ends the flight of a policy that stops."""
_ENDS: dict[FlightEnd, str] = {
    "course": "the end of the course",
    "stopped": "the policy's stop",
    "duration": "--duration",
    "landed": "a landing",
    "operator": "the operator",
    "signal": "a signal",
    "takeover": "a takeover",
    "disarmed": "disarming",
    "fault": "a fault",
}
_UNPLANNED = ("takeover", "disarmed", "fault")


class Standstill:
    """Tells by the ticks of a policy when it has stopped a vehicle that it had moved."""

    def __init__(self) -> None:
        self._has_moved = False
        self._since_ns: int | None = None

    def see(self, tick: Tick) -> None:
        """Follow a tick; those without the policy in control interrupt a standstill."""
        speed_mps = math.nan if tick.state is None else tick.state.speed_mps
        is_flying = tick.phase == Phase.FLYING
        self._has_moved = is_flying and (self._has_moved or speed_mps > MOVED_MPS)
        is_still = self._has_moved and speed_mps < STILL_MPS
        if not is_still:
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = tick.sent_ns

    def has_lasted(self, now_ns: int) -> bool:
        """True if the vehicle has been standing still for long enough."""
        return self._since_ns is not None and now_ns - self._since_ns >= STILL_NS


class FlightReferee:
    """``TickSink`` that follows the policy's flight to its outcome; other threads may ask it."""

    def __init__(self, gates: Sequence[CourseGate] | None, *, stops: bool = False) -> None:
        """``gates``: the course's gates in order; None if no course was named.

        ``stops``: the policy stops at the end, and the flight ends only then.
        """
        self._standstill = Standstill() if stops else None
        self._gates_total = len(gates) if gates else None
        self._course = CourseProgress(gates or ())
        self._crashes = CrashWatch()
        self._began_ns = 0
        self._flown: Tick | None = None
        """Last tick in which the policy had control."""
        self._has_position = self._is_flying = False
        self._ended: EndRequest | None = None
        """How the policy's last flight ended, as the guard has told it; None while it flies."""

    def emit(self, event: Event) -> None:
        """Follow the ticks from the policy's first action on."""
        if not isinstance(event, Tick):
            return
        if self._standstill is not None:
            self._standstill.see(event)
        was_flying, self._is_flying = self._is_flying, event.phase == Phase.FLYING
        if self._is_flying:
            self._began_ns = self._began_ns or event.sent_ns
            self._flown, self._ended = event, None
            self._has_position = self._has_position or event.position_ned_m is not None
        elif was_flying and event.release_reason is not None and event.end is not None:
            self._ended = EndRequest(event.release_reason, event.end)
        if self._began_ns:
            self._course.update(event.position_ned_m if self._is_flying else None, event.sent_ns)
            self._crashes.see(event)

    @property
    def crash(self) -> str | None:
        """Description of the crash; None if none was seen."""
        return self._crashes.reason

    def ending(self, now_ns: int) -> EndRequest | None:
        """Return the end of the course, or of a policy that stops; None before it.

        The course ends a run-out after the last gate; where the policy stops, once it has.
        """
        standstill = self._standstill
        has_stopped = standstill is not None and standstill.has_lasted(now_ns)
        if not self._course.is_done:
            return EndRequest(because(Code.POLICY_STOPPED), "stopped") if has_stopped else None
        run_out_ns = RUN_OUT_NS if standstill is None else MAX_RUN_OUT_NS
        is_over = has_stopped or now_ns - self._course.passed_ns[-1] >= run_out_ns
        return EndRequest(because(Code.COURSE_DONE), "course") if is_over else None

    def outcome(
        self, asked: EndRequest, vehicle: GuardStatus, told: GuardOutcome | None
    ) -> FlightOutcome | None:
        """Return the outcome of the flight; None if the policy has not flown.

        ``asked``: the end, if the guard died before it could tell one; ``told``: from its summary,
        up to which it has reported ``vehicle``.
        """
        if (flown := self._flown) is None:
            return None
        known: tuple[Reason | None, FlightEnd] = self._ended or asked
        if self._ended is None and told is not None and told.end is not None:
            known = (told.fault if told.end == "fault" else None), told.end
        reason, end = known
        position, state, passed_ns = flown.position_ned_m, flown.state, self._course.passed_ns
        knows_gates = self._gates_total is not None and self._has_position
        return FlightOutcome(
            end=end,
            reason=reason,
            flown_s=(flown.sent_ns - self._began_ns) / NS_PER_S,
            height_m=None if position is None else -position.down,
            speed_mps=None if state is None else state.speed_mps,
            mode=vehicle.mode,
            is_armed=vehicle.armed,
            is_landed=vehicle.is_landed,
            is_current=told is not None,
            gates_total=self._gates_total,
            gates_passed=len(passed_ns) if knows_gates else None,
            course_s=(passed_ns[-1] - self._began_ns) / NS_PER_S if passed_ns else None,
            course_speed_mps=self._course.speed_mps,
            crash=self.crash,
        )


def describe(outcome: FlightOutcome) -> str:
    """Return the outcome in one line."""
    course: list[str] = []
    if outcome.gates_total is not None:
        passed = "no position: ?" if outcome.gates_passed is None else outcome.gates_passed
        in_s = "" if outcome.course_s is None else f" in {outcome.course_s:.1f} s"
        course.append(f"{passed} of {outcome.gates_total} gates{in_s}")
        if outcome.course_speed_mps is not None:
            course.append(f"{outcome.course_speed_mps:.1f} m/s")
    if outcome.crash is not None:
        course.append(outcome.crash)
    elif course:
        course.append("no contact seen")
    if outcome.end == "course":
        return ", ".join(course)
    left = [f"ended by {_ENDS[outcome.end]} after {outcome.flown_s:.1f} s"]
    if outcome.height_m is not None:
        left.append(f"at {outcome.height_m:.1f} m")
    if outcome.speed_mps is not None:
        left.append(f"{outcome.speed_mps:.1f} m/s")
    state = "landed" if outcome.is_landed else "armed" if outcome.is_armed else "disarmed"
    seen = "now" if outcome.is_current else "last seen"
    left.append(f"{seen} {state} in {outcome.mode or 'an unknown mode'}")
    text = "; ".join(", ".join(part) for part in (course, left) if part)
    is_told = outcome.end in _UNPLANNED and outcome.reason is not None
    return f"{text}: {outcome.reason}" if is_told else text


def flight_verdict(
    summary: GuardSummary | None,
    stop: StopRequest,
    *,
    reason: Reason | None,
    readonly: bool,
    crash: str | None = None,
    record: Path | None = None,
) -> tuple[int, str | None]:
    """Return the exit status of a flight that ended without an exception, and why it is not 0.

    Args:
        summary: the guard's summary; None where it goes on without us.
        stop: the signals that have come.
        reason: why the policy does not fly now, from the last tick.
        readonly: nothing was sent, so there was nothing to fly.
        crash: how the vehicle hit something since the policy's first action, in words.
        record: folder of the recording, if there is one.
    """
    signal_number = stop.signal_number
    not_flown = ExitCode.NOT_FLOWN if signal_number is None else 128 + signal_number
    if summary is None:
        return not_flown, None
    outcome = summary.outcome
    if outcome.fault is not None:
        shown = f"; see it with: mavbridge inspect {shlex.quote(str(record))}" if record else ""
        fault = f"the policy's flight was ended by a fault: {outcome.fault}{shown}"
        return ExitCode.FAULT, fault
    if crash is not None and not readonly:
        return ExitCode.CRASHED, f"the vehicle has crashed: {crash}"
    if readonly and outcome.flights:
        return ExitCode.DONE, None
    if not outcome.flights:
        why = f": {reason}" if reason else ""
        return not_flown, f"the policy has not flown{why}"
    if outcome.has_left_ground is False:
        return not_flown, "the vehicle has not left the ground"
    if outcome.end == "disarmed":
        text = "the vehicle was disarmed, or restarted, while the policy flew it"
        return ExitCode.NOT_FLOWN, text
    return ExitCode.DONE, None


def log_link(summary: GuardSummary) -> None:
    """Log the received message rates and the parameters that were read."""
    rates = (f"{name} {rate_hz:.1f}" for name, rate_hz in summary.link.messages_per_s.items())
    _log.debug("received, in Hz: %s", ", ".join(rates))
    params = (f"{name}={value:g}" for name, value in sorted(summary.params.items()))
    _log.debug("parameters: %s", ", ".join(params))
