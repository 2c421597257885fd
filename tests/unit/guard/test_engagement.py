"""The engagement beyond single rows: acts of switch and arming, what is counted, what is told."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest

from helpers.guard_facts import (
    AIRBORNE,
    DEATH,
    FAULT,
    IDLE_RECEIVER,
    NO_RECEIVER,
    ON_GROUND,
    PX4_MODES,
    Stepped,
    altered,
    engagement_settings,
    flying,
)
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.guard.engagement import Engagement
from mavbridge.guard.values import ControlSource, EndRequest, EngagementOutput, GuardOutcome, Phase

NOTHING, FLIES = EngagementOutput(), EngagementOutput(control=ControlSource.POLICY)
RELEASE = EngagementOutput(control=ControlSource.RELEASE)
UNSEEN = because(Code.ARMED_UNSEEN)


# --- the engage switch and the first arming


def put(us: int, **lost: Any) -> dict[str, Any]:
    """The switch of channel 8 stands so, by a receiver that is well but for these facts."""
    well = {"is_failsafe": False, "is_receiver_sick": False, "channels_arrived_ns": None}
    return {"rc_channels_us": (1500,) * 7 + (us,), **well, **lost}


LOW, HIGH = put(1000), put(2000)
LOST = (
    put(1000, is_failsafe=True),
    put(1000, is_receiver_sick=True),
    put(1000, rc_channels_us=()),
    put(1000, channels_arrived_ns=1),
)
NO_READINGS = (0, 799, 2201, 65535)
BY_HAND = (
    [(0.3, put(1199)), (0.3, put(1801))],
    [(0.3, put(800)), (0.3, put(2200))],
    [(1.0, HIGH), (2.0, LOW), (0.21, HIGH)],
)
NOT_BY_HAND = (
    [(1.0, HIGH)],  # from the start
    *([(0.3, put(us)), (0.3, put(1801))] for us in (1200, *NO_READINGS)),
    *([(0.3, put(1199)), (0.3, put(us))] for us in (1800, *NO_READINGS)),
    # a gap of readings is no rest
    *([(3.0, before), (3.0, put(us)), (1.0, HIGH)] for before in (LOW, HIGH) for us in NO_READINGS),
    # nor is a dropout that puts the switch low, in flight or before
    *([(1.0, HIGH), (s, LOW), (2.0, HIGH)] for s in (0.02, 0.6, 1.5, 1.7)),
    *(
        [(1.0, HIGH), (0.01, {"act": "engage"}), (s, LOW), (2.0, HIGH)]
        for s in (0.02, 0.6, 1.5, 1.7)
    ),
    # a receiver that was lost has to show it low again
    *(
        [(3.0, LOW), (0.6, lost), (again_s, LOW), (1.0, HIGH)]
        for lost in LOST
        for again_s in (0.0, 0.3, 1.7)
    ),
    [(3.0, LOW), (0.2, HIGH), (0.01, put(2000, is_receiver_sick=True))],
    # arrivals count, and not the time for which an old value stays
    [(0.45, put(1000, channels_arrived_ns=0)), (0.45, put(2000, channels_arrived_ns=450_000_000))],
)


@pytest.mark.parametrize("history", BY_HAND)
def test_the_switch_engages_by_going_high_after_a_rest_and_releases_by_going_low(
    history: Any,
) -> None:
    stepped = Stepped(engage_channel=8)
    for seconds, changes in history:
        stepped.run(seconds, **changes)
    assert stepped.phase is Phase.FLYING
    assert stepped.engagement.refusal is None
    assert stepped.step(**LOW) == RELEASE, "low is taken at its word"
    assert stepped.codes == (Code.ENGAGE_SWITCH_OFF,)


@pytest.mark.parametrize("history", NOT_BY_HAND)
def test_what_looks_like_a_hand_on_the_switch_engages_nothing_and_a_hand_does(history: Any) -> None:
    stepped = Stepped(engage_channel=8)
    for seconds, changes in history:
        stepped.run(seconds, **changes)
    assert stepped.phase is not Phase.FLYING
    stepped.run(2.0, **LOW)
    stepped.run(0.3, **HIGH)
    assert stepped.phase is Phase.FLYING


def test_a_switch_that_has_not_rested_is_told() -> None:
    stepped = Stepped(engage_channel=8)
    for seconds, changes in ((3.0, LOW), (0.6, LOST[0]), (1.7, LOW), (1.0, HIGH)):
        stepped.run(seconds, **changes)
    not_rested = because(Code.SWITCH_NOT_RESTED, channel=8, rest_s=1.8)
    assert stepped.engagement.refusal == because(Code.NOT_ENGAGED_SINCE, why=not_rested)


@pytest.mark.parametrize("put_so", [LOW, HIGH])
def test_a_switch_that_stays_where_it_is_is_no_act_to_tell_of(put_so: dict[str, Any]) -> None:
    stepped = Stepped(engage_channel=8)
    assert set(stepped.run(0.5, **put_so)) == {NOTHING}
    assert stepped.engagement.refusal is None


def test_the_key_wins_over_the_switch_of_the_same_step() -> None:
    stepped = Stepped(engage_channel=8)
    stepped.run(0.3, **LOW)
    stepped.run(0.2, **HIGH)
    assert (stepped.step("release"), stepped.engagement.refusal) == (NOTHING, None)


@pytest.mark.parametrize("silent_s", [0.0, 4.0])
def test_engage_on_arm_counts_the_first_arming_alone(silent_s: float) -> None:
    stepped = Stepped(ON_GROUND, engage_on_arm=True)
    stepped.run(0.1)
    assert stepped.engagement.refusal is None
    assert stepped.step(armed=True) == FLIES
    assert (stepped.step(), stepped.engagement.refusal) == (FLIES, None)
    stepped.step(armed=False)
    stepped.run(silent_s, armed_arrived_ns=stepped.facts.now_ns)
    stepped.run(2, is_released=True, armed_arrived_ns=None)
    assert set(stepped.run(2, armed=True)) == {NOTHING}


@pytest.mark.parametrize("found_ns", [0, NS_PER_S])
def test_a_vehicle_that_is_found_armed_was_not_armed_for_us(found_ns: int) -> None:
    facts = replace(ON_GROUND, link=replace(ON_GROUND.link, status=None))
    stepped = Stepped(facts, engage_on_arm=True)
    stepped.run(found_ns / NS_PER_S)
    assert set(stepped.run(1, armed=True, mode="ALT_HOLD")) == {NOTHING}
    assert stepped.engagement.refusal == because(Code.NOT_ENGAGED_SINCE, why=UNSEEN)


def test_an_act_in_the_step_in_which_an_armed_vehicle_is_found_engages() -> None:
    stepped = Stepped(AIRBORNE, engage_on_arm=True)
    assert stepped.step("engage") == FLIES
    assert stepped.engagement.refusal is None


@pytest.mark.parametrize(
    ("seconds", "unheard"),
    [(0.3, ("heard_ns", "mode_arrived_ns")), (2.9, ()), (2.95, ())],
)
@pytest.mark.parametrize("is_seen_disarmed", [True, False])
def test_an_arming_during_a_silence_is_no_act(
    seconds: float, unheard: tuple[str, ...], is_seen_disarmed: bool
) -> None:
    stepped = Stepped(ON_GROUND, engage_on_arm=True)
    stepped.run(0.1)
    told = dict.fromkeys(("armed_arrived_ns", *unheard), stepped.facts.now_ns)
    stepped.run(seconds, **told)
    assert stepped.engagement.refusal is None
    stepped.run(0.05, heard_ns=None, mode_arrived_ns=None)  # CURRENT_MODE tells of no arming
    if is_seen_disarmed:
        stepped.step(armed_arrived_ns=None)
    is_act = is_seen_disarmed or seconds == 2.9
    assert stepped.step(armed_arrived_ns=None, armed=True) == (FLIES if is_act else NOTHING)
    why = None if is_act else because(Code.NOT_ENGAGED_SINCE, why=UNSEEN)
    assert stepped.engagement.refusal == why


# --- what is remembered from one flight to the next


def test_the_safe_mode_of_the_last_flight_is_the_pilots_in_the_next_one() -> None:
    stepped = flying(on_fault="hold")
    stepped.step(**FAULT)
    stepped.run(0.2, mode="BRAKE")
    stepped.run(1.5)
    stepped.step(mode="ALT_HOLD", chunk_fault=None)
    stepped.step("engage")
    assert stepped.phase is Phase.FLYING
    assert stepped.step(mode="BRAKE") == RELEASE


def test_an_interruption_before_the_act_is_forgotten_one_after_it_is_not() -> None:
    rebooted = {"interruption": because(Code.REBOOTED), "interruptions": 1}
    stepped = Stepped(altered(ON_GROUND, **rebooted), arm=True)
    stepped.run(0.1, echo_confirmed=True)
    stepped.step(armed=True)
    assert stepped.step() == FLIES
    assert stepped.step(interruption=because(Code.REBOOTED)) == RELEASE


def test_the_duration_counts_from_the_first_engagement_on_and_through_takeovers() -> None:
    stepped = Stepped(duration_ns=NS_PER_S)
    stepped.run(3)
    stepped.step("engage")
    stepped.run(0.5)
    stepped.step(mode="LOITER")
    stepped.run(0.1, is_released=True, mode="ALT_HOLD")
    stepped.step("engage")
    stepped.run(0.37)
    assert stepped.phase is Phase.FLYING
    assert stepped.step().control is ControlSource.NEUTRAL
    stepped.run(0.1)
    assert stepped.phase is Phase.ENDED


# --- what is told


def test_a_vehicle_that_was_not_ready_is_told_as_it_was() -> None:
    stepped = Stepped(altered(ON_GROUND, chunk_problem=because(Code.NO_IMAGE)), arm=True)
    stepped.run(92, is_released=True)
    assert stepped.phase is Phase.ENDED
    failure = because(
        Code.NOT_READY,
        after_s=90,
        mode="ALT_HOLD",
        is_armed=False,
        is_echoed=False,
        inputs=because(Code.NO_IMAGE),
    )
    assert stepped.engagement.outcome == GuardOutcome(failure=failure), "the policy never flew"


def test_each_flight_and_how_it_ended_is_counted() -> None:
    stepped = flying(altered(AIRBORNE, is_landed=None))
    stepped.step()
    assert stepped.engagement.outcome == GuardOutcome(flights=1)
    stepped.step(is_landed=True)
    assert stepped.engagement.outcome.has_left_ground is False
    stepped.step(is_landed=False)
    stepped.step(is_landed=True)
    stepped.step(**FAULT)
    fault = GuardOutcome(1, has_left_ground=True, end="fault", fault=FAULT["chunk_fault"])
    assert stepped.engagement.outcome == fault
    stepped.run(0.2, chunk_fault=None, is_released=True)
    stepped.step("engage")
    assert stepped.engagement.outcome == fault._replace(flights=2, end=None)
    stepped.step(armed=False)
    disarmed = fault._replace(flights=2, end="disarmed")
    assert stepped.engagement.outcome == disarmed
    stepped.run(0.2, armed=True)
    stepped.step("engage")
    assert stepped.engagement.outcome == fault._replace(flights=3, end=None)
    stepped.step("release")
    assert stepped.engagement.outcome == fault._replace(flights=3, end="operator")


@pytest.mark.parametrize(
    ("change", "end"),
    [
        ({"mode": "LOITER"}, "takeover"),
        ({"stop": EndRequest(because(Code.COURSE_DONE), end="course")}, "course"),
        ({"stop": EndRequest(because(Code.SIGNAL))}, "signal"),
        ({"stop": DEATH}, "fault"),
        ({"landing": because(Code.LANDED)}, "landed"),
    ],
)
def test_how_a_flight_ended_is_told_by_its_code(change: dict[str, Any], end: str) -> None:
    stepped = flying(NO_RECEIVER)
    stepped.step(**change)
    outcome = stepped.engagement.outcome
    assert (outcome.end, outcome.fault is not None) == (end, end == "fault")
    stepped.run(0.2, mode="LAND", act=None)
    stepped.step(armed=False)
    assert stepped.engagement.outcome == outcome, "a disarming on the way out is how it should end"


# --- read-only


def test_readonly_flies_whenever_it_could_and_never_asks() -> None:
    stepped = Stepped(altered(AIRBORNE, armed=False, mode="RTL"), readonly=True)
    assert set(stepped.run(1)) == {FLIES}
    assert stepped.step(chunk_problem=because(Code.NO_IMAGE)) == NOTHING
    assert (stepped.phase, stepped.codes) == (Phase.WAITING, (Code.NO_IMAGE,))
    assert stepped.step(chunk_problem=None) == FLIES
    assert (stepped.codes, stepped.engagement.outcome.flights) == ((), 2)


def test_readonly_waits_for_the_policys_reset_and_stops_at_an_objection() -> None:
    stepped, late, lost = Stepped(readonly=True), because(Code.NO_IMAGE), Code.HEARTBEAT_LOST
    assert stepped.step(is_policy_reset=False, chunk_problem=late) == NOTHING
    assert stepped.engagement.starting_ns is None
    assert stepped.step(chunk_problem=None) == NOTHING
    began_ns = stepped.facts.now_ns
    assert stepped.step(chunk_problem=late) == NOTHING  # it is silent while it is reset
    assert stepped.engagement.starting_ns == began_ns
    assert stepped.step(is_policy_reset=True) == NOTHING
    assert stepped.step(chunk_problem=None) == FLIES
    assert stepped.step(problem=because(lost)) == NOTHING
    assert stepped.step(chunk_problem=late) == NOTHING
    assert stepped.codes == (lost,)


def test_the_first_chunk_after_a_reset_may_take_two_periods_more() -> None:
    stepped = Stepped()
    stepped.engagement = Engagement(engagement_settings(), chunk_period_ns=NS_PER_S)
    stepped.step()
    stepped.step("engage", is_policy_reset=False)
    stepped.run(5.0)
    assert stepped.phase is Phase.PREPARING
    stepped.step(problem=because(Code.HEARTBEAT_LOST))
    assert stepped.engagement.starting_ns is None
    assert stepped.phase is not Phase.PREPARING


def test_readiness_that_comes_and_goes_does_not_prolong_the_way_in() -> None:
    stepped = Stepped()
    stepped.step()
    stepped.step("engage", is_policy_reset=False)
    for _ in range(4):
        stepped.run(0.5, problem=because(Code.HEARTBEAT_LOST))
        assert stepped.engagement.starting_ns is None, "the next reset begins anew"
        stepped.run(0.5, problem=None)
    assert stepped.phase is not Phase.PREPARING


def test_a_vehicle_that_is_silent_from_the_start_is_no_error() -> None:
    assert Stepped().step(heard_ns=-NS_PER_S) == NOTHING


def test_watching_that_never_flew_ends_no_flight() -> None:
    stepped = Stepped(altered(AIRBORNE, chunk_problem=because(Code.NO_IMAGE)), readonly=True)
    stepped.step()
    assert stepped.step(stop=DEATH) == NOTHING
    assert (stepped.phase, stepped.engagement.outcome) == (Phase.ENDED, GuardOutcome())


@pytest.mark.parametrize("ends", ["stop", "duration"])
@pytest.mark.parametrize("at_last", [FLIES, NOTHING])
def test_watching_ends_as_a_flight_does(ends: str, at_last: EngagementOutput) -> None:
    stepped = Stepped(readonly=True, duration_ns=NS_PER_S if ends == "duration" else None)
    assert set(stepped.run(0.9)) == {FLIES}
    late = None if at_last == FLIES else because(Code.NO_IMAGE)
    assert set(stepped.run(0.1, chunk_problem=late)) == {at_last}
    assert stepped.step(stop=DEATH if ends == "stop" else None) == NOTHING
    assert stepped.phase is Phase.ENDED
    assert stepped.engagement.outcome.end == ("fault" if ends == "stop" else ends)


# --- last words


NEUTRAL = ControlSource.NEUTRAL
PX4 = altered(NO_RECEIVER, mode="ALTCTL", modes=PX4_MODES)
FIRST_MS = (0, 20, 40, 100, 150, 200, 250)


def asking(mode: str, at_ms: tuple[int, ...], times_ms: tuple[int, ...] = FIRST_MS) -> list[Any]:
    return [(ms, NEUTRAL, mode if ms in at_ms else None) for ms in times_ms]


def releasing(from_ms: int) -> list[Any]:
    return [(from_ms + k * 50, ControlSource.RELEASE, None) for k in range(5)]


def left_by_key() -> Stepped:
    stepped = flying(NO_RECEIVER)
    stepped.step("release")
    stepped.run(0.2, mode="LAND")
    return stepped


def held_by_key() -> Stepped:
    stepped = flying(NO_RECEIVER, then="hold", on_fault="land")
    stepped.step("release")
    stepped.run(0.2, mode="BRAKE")
    return stepped


def left_by_fault() -> Stepped:
    stepped = flying(IDLE_RECEIVER)
    stepped.step(**FAULT)
    return stepped


def stood_still() -> Stepped:
    stepped = flying(NO_RECEIVER)
    stepped.facts = altered(stepped.facts, now_ns=NS_PER_S)
    stepped.step(mode_arrived_ns=0)
    return stepped


def asked() -> Stepped:
    stepped = Stepped(altered(AIRBORNE, mode="LOITER", is_released=True), mode="ALT_HOLD")
    stepped.step()
    stepped.step("engage")
    return stepped


@pytest.mark.parametrize(
    ("start", "words"),
    [
        (lambda: flying(IDLE_RECEIVER), asking("BRAKE", (0, 100, 200)) + releasing(250)),
        (left_by_fault, asking("BRAKE", (0, 100, 200)) + releasing(250)),
        (lambda: flying(NO_RECEIVER), asking("BRAKE", (0, 100, 200))),
        (flying, asking("", (), (0, 20, 40)) + releasing(100)),
        (left_by_key, asking("LAND", ())),
        (held_by_key, asking("BRAKE", ())),
        (stood_still, asking("BRAKE", (100, 200))),
        (asked, []),
        (
            lambda: flying(PX4),
            asking("AUTO.LOITER", (1000, 1100, 1200), (0, 20, 40, *range(100, 1251, 50))),
        ),
        (
            lambda: flying(altered(PX4, mode="OFFBOARD"), is_setpoint=True, modes=("OFFBOARD",)),
            asking("AUTO.LOITER", (0, 100, 200)),
        ),
    ],
)
def test_the_words_of_a_guard_that_dies(start: Callable[[], Stepped], words: list[Any]) -> None:
    stepped = start()
    now_ns = stepped.facts.now_ns
    facts = altered(stepped.facts, heard_ns=now_ns, mode_arrived_ns=now_ns)
    said = stepped.engagement.rehearse(facts)
    found = [(after_ns // NS_PER_MS, move.control, move.mode) for after_ns, move in said]
    assert found == words
