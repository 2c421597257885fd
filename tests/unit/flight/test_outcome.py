"""What a script and a person are told about a flight."""

import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.factories import make_released_tick, make_state, make_tick
from helpers.fakes import FakeClock
from mavbridge.core.course import CourseGate
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.records import FlightOutcome, Position, Tick
from mavbridge.core.stopping import StopRequest
from mavbridge.core.vehicle import FlightEnd, LinkStats
from mavbridge.flight.outcome import (
    MAX_RUN_OUT_NS,
    RUN_OUT_NS,
    STILL_NS,
    FlightReferee,
    describe,
    flight_verdict,
)
from mavbridge.guard.values import EndRequest, GuardOutcome
from mavbridge.guard.wire import GuardStatus, GuardSummary

FLOWN = GuardOutcome(flights=1, has_left_ground=True)
NO_CHUNK = because(Code.NO_CHUNK)
FAULT = because(Code.POLICY_FAILED)
HIT = "it hit gate 7"
STATS = LinkStats(
    messages_per_s={},
    lost_fraction=None,
    rtt_ms=None,
    sent_actions=0,
    echo_confirmed=None,
    vehicle_clock_offset_ns=None,
)


def summary(outcome: GuardOutcome) -> GuardSummary:
    return GuardSummary(
        link=STATS,
        outcome=outcome,
        params={},
        dropped_messages=0,
        dropped_packets=0,
    )


def stopped(number: int | None) -> StopRequest:
    stop = StopRequest(FakeClock())
    stop.signal_number = number
    return stop


@pytest.mark.parametrize(
    ("outcome", "number", "crash", "status", "told"),
    [
        (FLOWN, None, None, 0, None),
        (FLOWN, signal.SIGINT, None, 0, None),  # Ctrl-C is how a flight without a duration ends
        (FLOWN._replace(has_left_ground=None), None, None, 0, None),  # the vehicle does not tell
        (FLOWN._replace(fault=FAULT), None, None, 4, "a fault"),
        (FLOWN._replace(flights=3, fault=FAULT), signal.SIGINT, None, 4, "a fault"),
        (FLOWN._replace(end="disarmed"), None, None, 3, "was disarmed"),
        (FLOWN._replace(has_left_ground=False), None, None, 3, "not left the ground"),
        (FLOWN._replace(has_left_ground=False), signal.SIGTERM, None, 143, "not left the ground"),
        (GuardOutcome(), None, None, 3, f"the policy has not flown: {NO_CHUNK}"),
        (GuardOutcome(), signal.SIGINT, None, 130, "the policy has not flown"),
        (None, signal.SIGINT, None, 130, None),  # an impatient user, while the guard holds neutral
        (None, None, None, 3, None),
        (FLOWN, None, HIT, 6, HIT),
        (FLOWN, signal.SIGINT, HIT, 6, HIT),
        (FLOWN._replace(end="disarmed"), None, HIT, 6, HIT),
        (FLOWN._replace(fault=FAULT), None, HIT, 4, ""),  # a fault comes first
        (None, None, HIT, 3, None),
    ],
)
def test_the_status_says_what_a_script_needs(
    outcome: GuardOutcome | None,
    number: int | None,
    crash: str | None,
    status: int,
    told: str | None,
) -> None:
    words = None if outcome is None else summary(outcome)
    exit_code, text = flight_verdict(
        words, stopped(number), reason=NO_CHUNK, readonly=False, crash=crash
    )
    assert exit_code == status
    assert (told or "") in (text or "")
    assert (told is None) == (text is None)


@pytest.mark.parametrize("record", [None, Path("flights/a b")])
def test_a_fault_is_told_with_its_cause_and_the_command_that_shows_it(record: Path | None) -> None:
    old = because(Code.TOO_OLD, quantity="attitude", age_ms=104.0, limit_ms=100.0)
    words = summary(FLOWN._replace(fault=old))
    _, told = flight_verdict(words, stopped(None), reason=None, readonly=False, record=record)
    end = "" if record is None else "; see it with: mavbridge inspect 'flights/a b'"
    assert (told or "").endswith(f": {old}{end}")


def test_a_flight_that_sends_nothing_needs_no_air() -> None:
    watched = summary(GuardOutcome(flights=1, has_left_ground=False))
    assert flight_verdict(watched, stopped(None), reason=None, readonly=True)[0] == 0
    unseen = summary(GuardOutcome())
    assert flight_verdict(unseen, stopped(None), reason=None, readonly=True)[0] == 3


GATES = [CourseGate(Position(north, 0.0, -2.0), 0.0, 2.4) for north in (4.0, 8.0)]
HOVERING = GuardStatus("ardupilot", "LOITER", True, False, (), None)
DEATH = EndRequest(because(Code.GUARD_DIED), "fault")


def course_ticks(count: int, **changes: Any) -> list[Tick]:
    """Flight to the north at 10 m/s, from 2 m up at the origin: gates after 0.4 and 0.8 s."""
    speed = np.array([6.0, 8.0, 0.0, 1, 0, 0, 0, 0, 0, 0, 0, 0, -9.8], np.float32)
    return [
        make_tick(
            index,
            phase="flying",
            position_ned_m=Position(0.1 * index, 0.0, -2.0),
            state=make_state(values=speed),
            **changes,
        )
        for index in range(count)
    ]


def judged(
    ticks: list[Tick], end: FlightEnd, *, gates: list[CourseGate] | None = GATES
) -> FlightOutcome:
    referee = FlightReferee(gates)
    for tick in ticks:
        referee.emit(tick)
    outcome = referee.outcome(EndRequest(FAULT, end), HOVERING, GuardOutcome(end=end, fault=FAULT))
    assert outcome is not None
    return outcome


def test_a_course_is_over_a_second_after_its_last_guard() -> None:
    referee, ticks = FlightReferee(GATES), course_ticks(300)
    over = [tick.index for tick in ticks if referee.emit(tick) or referee.ending(tick.sent_ns)]
    assert over[0] == 80 + RUN_OUT_NS // 10_000_000
    ending = referee.ending(ticks[-1].sent_ns)
    assert ending == EndRequest(because(Code.COURSE_DONE), "course")
    outcome = referee.outcome(ending, HOVERING, GuardOutcome(end="course"))
    assert outcome is not None
    assert (outcome.gates_passed, outcome.gates_total, outcome.success) == (2, 2, True)
    assert outcome.course_s == pytest.approx(0.8)
    assert outcome.course_speed_mps == pytest.approx(10.0)
    assert describe(outcome) == "2 of 2 gates in 0.8 s, 10.0 m/s, no contact seen"


STILL = STILL_NS // 10_000_000


def stopping(*speeds_mps: float, gates: list[CourseGate] | None) -> tuple[int, str] | None:
    """Return tick and kind of the end of a flight with these speeds, each for 2 s."""
    referee = FlightReferee(gates, stops=True)
    for index, tick in enumerate(course_ticks(1900)):
        moving = np.zeros(13, np.float32)
        moving[0] = speeds_mps[min(index // 200, len(speeds_mps) - 1)]
        referee.emit(replace(tick, state=make_state(values=moving)))
        if (ending := referee.ending(tick.sent_ns)) is not None:
            return index, ending.end
    return None


def test_a_policy_that_stops_ends_its_flight_by_that() -> None:
    assert stopping(6.0, 2.0, 0.2, gates=None) == (400 + STILL, "stopped")
    assert stopping(6.0, 2.0, 0.2, gates=GATES) == (400 + STILL, "course")
    assert stopping(0.1, 0.4, gates=None) is None, "it has not flown yet"
    assert stopping(6.0, 3.0, gates=None) is None
    late = 80 + MAX_RUN_OUT_NS // 10_000_000
    assert stopping(3.0, gates=GATES) == (late, "course"), "at last"


@pytest.mark.parametrize("before", ["preparing", "waiting", "flying", "released"])
def test_what_moved_the_vehicle_before_the_flight_does_not_end_it(before: str) -> None:
    referee = FlightReferee(None, stops=True)
    phases = [before] * 50 + ["released"] * (before == "flying") + ["flying"] * 300
    for tick, phase in zip(course_ticks(len(phases)), phases, strict=True):
        moving = np.zeros(13, np.float32)
        moving[0] = 2.5 if phase == before and tick.index < 50 else 0.1
        referee.emit(replace(tick, phase=phase, state=make_state(values=moving)))
        assert referee.ending(tick.sent_ns) is None


def test_without_guards_a_flight_is_told_by_its_end() -> None:
    outcome = judged(course_ticks(201), "duration", gates=None)
    assert (outcome.gates_total, outcome.gates_passed, outcome.success) == (None, None, None)
    assert (outcome.height_m, outcome.speed_mps) == (2.0, 10.0)
    told = "ended by --duration after 2.0 s, at 2.0 m, 10.0 m/s, now armed in LOITER"
    assert describe(outcome) == told
    assert FlightReferee(None).ending(10**18) is None
    assert FlightReferee(GATES).outcome(DEATH, HOVERING, None) is None, "nobody has flown"


def test_each_flight_ends_as_the_guard_tells_and_by_its_death_before() -> None:
    taken = EndRequest(because(Code.MODE_CHANGED, before="ALT_HOLD", after="LOITER"), "takeover")
    later = make_released_tick(52, because(Code.THEN, first=taken.reason, then=NO_CHUNK))
    first = [*course_ticks(50), make_released_tick(51, taken.reason, end="takeover"), later]
    referee = FlightReferee(None)
    for ticks, (reason, end) in ((first, taken), (course_ticks(50), DEATH)):
        for tick in ticks:
            referee.emit(tick)
        outcome = referee.outcome(DEATH, HOVERING, None)
        assert outcome is not None
        assert (outcome.reason, outcome.end) == (reason, end)
    assert describe(outcome).endswith("last seen armed in LOITER: the guard has died")
    assert "last seen armed in an unknown mode: " in describe(replace(outcome, mode=None))


@pytest.mark.parametrize(("end", "reason"), [("fault", FAULT), ("takeover", None)])
def test_an_end_of_which_no_tick_came_through_is_told_by_the_summary(
    end: FlightEnd, reason: Reason | None
) -> None:
    referee, asked = FlightReferee(None), EndRequest(because(Code.SIGNAL))
    for tick in course_ticks(50):
        referee.emit(tick)
    outcome = referee.outcome(asked, HOVERING, GuardOutcome(flights=1, end=end, fault=FAULT))
    assert outcome is not None
    assert (outcome.end, outcome.reason) == (end, reason)


def test_what_the_vehicle_hit_is_told_and_counts_also_just_behind_the_last_guard() -> None:
    hit = make_tick(90, phase="flying", texts=("vehicle: Crash: hit gate 1 at 9.9 m/s",))
    outcome = judged([*course_ticks(90), hit], "course")
    assert (outcome.gates_passed, outcome.success) == (2, False)
    assert describe(outcome).endswith(", the vehicle said 'Crash: hit gate 1 at 9.9 m/s'")
    before = make_released_tick(0, phase="waiting", texts=("vehicle: Crash: Disarming",))
    assert judged([before, *course_ticks(100)], "course").crash is None


def test_a_vehicle_without_a_position_passes_no_guard_and_misses_none() -> None:
    outcome = judged([make_tick(k, phase="flying") for k in range(50)], "duration")
    assert (outcome.gates_total, outcome.gates_passed, outcome.success) == (2, None, None)
    assert describe(outcome).startswith("no position: ? of 2 gates, no contact seen; ended by")


@pytest.mark.parametrize(
    ("phase", "is_crash"),
    [("flying", True), ("leaving", True), ("holding", False), ("releasing", False)],
)
def test_a_fall_after_a_disarming_is_a_crash_of_our_own_flight_alone(
    phase: str, is_crash: bool
) -> None:
    falling = make_state(values=course_ticks(1)[0].state.values)  # type: ignore[union-attr]
    disarmed: dict[str, Any] = {"phase": "releasing", "armed": False, "state": falling}
    why = because(Code.DISARMED)
    after = [make_released_tick(51 + k, why, **disarmed) for k in range(20)]
    if not is_crash:
        disarmed["texts"] = ("vehicle: Crash: hit ground",)
        after.append(make_released_tick(71, why, **disarmed))
    flown = [*course_ticks(50), make_tick(50, phase=phase)]
    outcome = judged([*flown, *after], "duration")
    assert (outcome.crash is not None) == is_crash
