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
from mavbridge.guard.values import NOT_FOUND, Actions, ControlSource, EndRequest, Outcome, Phase

NOTHING, FLIES = Actions(), Actions(control=ControlSource.POLICY)
RELEASE = Actions(control=ControlSource.RELEASE)
LOW, HIGH = (1500,) * 7 + (1000,), (1500,) * 7 + (2000,)


# --- the engage switch and the first arming


def switched(us: int = 1000, **changes: Any) -> Stepped:
    return Stepped(
        altered(AIRBORNE, rc_channels_us=(1500,) * 7 + (us,), **changes), engage_channel=8
    )


def test_the_switch_engages_by_going_high_after_a_rest_and_releases_by_going_low() -> None:
    stepped = switched(2000)
    assert set(stepped.run(1)) == {NOTHING}  # it was high from the start
    stepped.run(2, rc_channels_us=LOW)
    assert stepped.engagement.refusal is None
    assert stepped.run(0.21, rc_channels_us=HIGH)[-1] == FLIES
    assert stepped.engagement.refusal is None
    assert stepped.step(rc_channels_us=LOW) == RELEASE
    assert stepped.codes == (Code.ENGAGE_SWITCH_OFF,)


@pytest.mark.parametrize(
    ("low_us", "high_us", "engages"),
    [
        (1199, 1801, True),
        (800, 2200, True),
        (799, 1801, False),  # no reading of a radio
        (1199, 2201, False),
        (1200, 1801, False),
        (1199, 1800, False),
        (0, 2000, False),  # a channel that the receiver does not have
        (65535, 2000, False),
    ],
)
def test_the_switch_engages_from_below_1200_to_above_1800(
    low_us: int, high_us: int, engages: bool
) -> None:
    stepped = Stepped(altered(AIRBORNE, rc_channels_us=(low_us,)), engage_channel=1)
    stepped.run(0.3)
    stepped.run(0.3, rc_channels_us=(high_us,))
    assert (stepped.phase is Phase.FLYING) == engages


@pytest.mark.parametrize("unused_us", [0, 799, 2201, 65535])
@pytest.mark.parametrize("before", [LOW, HIGH])
def test_a_gap_of_readings_is_no_rest(unused_us: int, before: tuple[int, ...]) -> None:
    stepped = Stepped(altered(AIRBORNE, rc_channels_us=before), engage_channel=8)
    stepped.run(3)
    assert set(stepped.run(3, rc_channels_us=(*HIGH[:7], unused_us))) == {NOTHING}
    assert set(stepped.run(1, rc_channels_us=HIGH)) == {NOTHING}
    stepped.run(2, rc_channels_us=LOW)
    assert FLIES in stepped.run(0.3, rc_channels_us=HIGH)


@pytest.mark.parametrize("seconds", [0.02, 0.6, 1.5, 1.7])
@pytest.mark.parametrize("is_flying", [False, True])
def test_a_dropout_that_puts_the_switch_low_is_no_act(seconds: float, is_flying: bool) -> None:
    stepped = switched(2000)
    stepped.run(1)
    if is_flying:
        stepped.step("engage")
    first, *rest = stepped.run(seconds, rc_channels_us=LOW)
    assert first == (RELEASE if is_flying else NOTHING), "low is taken at its word"
    assert FLIES not in (*rest, *stepped.run(2, rc_channels_us=HIGH))


@pytest.mark.parametrize(
    "lost",
    [
        {"is_failsafe": True},
        {"is_receiver_sick": True},
        {"rc_channels_us": ()},
        {"rc_channels_us": LOW, "channels_arrived_ns": 1},
    ],
)
@pytest.mark.parametrize("again_s", [0.0, 0.3, 1.7])
def test_a_receiver_that_was_lost_has_to_show_the_switch_low_again(
    lost: dict[str, Any], again_s: float
) -> None:
    stepped = switched()
    stepped.run(3)
    stepped.run(0.6, **lost)
    well = {"is_failsafe": False, "is_receiver_sick": False, "channels_arrived_ns": None}
    stepped.run(again_s, rc_channels_us=LOW, **well)
    assert set(stepped.run(1, rc_channels_us=HIGH, **well)) == {NOTHING}
    not_rested = because(Code.SWITCH_NOT_RESTED, channel=8, rest_s=1.8)
    assert stepped.engagement.refusal == because(Code.NOT_ENGAGED_SINCE, why=not_rested)
    stepped.run(2, rc_channels_us=LOW)
    assert FLIES in stepped.run(0.3, rc_channels_us=HIGH)


def test_a_receiver_that_is_sick_as_the_switch_goes_high_engages_nothing() -> None:
    stepped = switched()
    stepped.run(3)
    stepped.run(0.2, rc_channels_us=HIGH)
    assert stepped.step(is_receiver_sick=True) == NOTHING


def test_the_dwell_counts_arrivals_and_not_the_time_that_an_old_value_stays() -> None:
    stepped = switched(channels_arrived_ns=0)
    stepped.run(0.45)
    now_ns = stepped.facts.now_ns
    assert set(stepped.run(0.45, rc_channels_us=HIGH, channels_arrived_ns=now_ns)) == {NOTHING}


def test_a_switch_on_a_channel_that_does_not_arrive_is_not_off() -> None:
    stepped = Stepped(engage_channel=9)
    stepped.step()
    assert stepped.step("engage") == FLIES


def test_engage_on_arm_counts_the_first_arming_alone() -> None:
    stepped = Stepped(ON_GROUND, engage_on_arm=True)
    stepped.run(0.1)
    assert stepped.engagement.refusal is None
    assert stepped.step(armed=True) == FLIES
    stepped.step(armed=False)
    stepped.run(2, is_released=True)
    assert set(stepped.run(2, armed=True)) == {NOTHING}


@pytest.mark.parametrize("found_ns", [0, NS_PER_S])
def test_a_vehicle_that_is_found_armed_was_not_armed_for_us(found_ns: int) -> None:
    facts = replace(ON_GROUND, link=replace(ON_GROUND.link, status=None), status=NOT_FOUND)
    stepped = Stepped(facts, engage_on_arm=True)
    stepped.run(found_ns / NS_PER_S)
    assert set(stepped.run(1, armed=True, mode="ALT_HOLD")) == {NOTHING}


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


def test_a_key_on_the_way_in_is_the_whole_reason_and_a_later_act_has_3_s() -> None:
    stepped = Stepped(altered(ON_GROUND, echo_confirmed=True), arm=True)
    stepped.run(0.1)
    stepped.step("release")
    assert stepped.codes == (Code.OPERATOR,)
    stepped.run(0.1, is_released=True, armed=True, is_landed=False)
    stepped.step("engage", is_policy_reset=False)
    stepped.run(3.0)
    assert stepped.phase is Phase.PREPARING
    stepped.step()
    assert stepped.phase is Phase.RELEASED


def test_a_wrong_mode_is_told_with_the_right_ones() -> None:
    stepped = Stepped(altered(AIRBORNE, mode="LOITER"))
    stepped.step("engage")
    wrong = because(Code.WRONG_MODE, mode="LOITER", allowed="ALT_HOLD or ALTCTL")
    assert stepped.engagement.refusal == because(Code.NOT_ENGAGED_SINCE, why=wrong)


def test_a_vehicle_that_was_not_ready_is_told_as_it_was() -> None:
    stepped = Stepped(altered(ON_GROUND, chunk_problem=because(Code.NO_IMAGE)), arm=True)
    stepped.run(92, is_released=True)
    assert stepped.phase is Phase.ENDED
    assert stepped.engagement.failure == because(
        Code.NOT_READY,
        after_s=90,
        mode="ALT_HOLD",
        is_armed=False,
        is_echoed=False,
        inputs=because(Code.NO_IMAGE),
    )
    assert stepped.engagement.outcome == (0, None, 0, False, None, None), "the policy never flew"


def test_each_flight_and_how_it_ended_is_counted() -> None:
    stepped = flying(altered(AIRBORNE, is_landed=None))
    stepped.step()
    assert stepped.engagement.outcome == Outcome(flights=1)
    stepped.step(is_landed=True)
    assert stepped.engagement.outcome.has_left_ground is False
    stepped.step(is_landed=False)
    stepped.step(is_landed=True)
    stepped.step(**FAULT)
    fault = Outcome(1, has_left_ground=True, faults=1, end="fault", fault=FAULT["chunk_fault"])
    assert stepped.engagement.outcome == fault
    stepped.run(0.2, chunk_fault=None, is_released=True)
    stepped.step("engage")
    assert stepped.engagement.outcome == fault._replace(flights=2, end=None)
    stepped.step(armed=False)
    disarmed = fault._replace(flights=2, end="disarmed", is_disarmed=True)
    assert stepped.engagement.outcome == disarmed
    stepped.run(0.2, armed=True)
    stepped.step("engage")
    assert stepped.engagement.outcome == fault._replace(flights=3, end=None)
    stepped.step(mode="LOITER")
    assert stepped.engagement.outcome == fault._replace(flights=3, end="takeover")


@pytest.mark.parametrize(
    ("change", "end"),
    [
        ({"act": "release"}, "operator"),
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
    assert (outcome.end, outcome.faults) == (end, int(end == "fault"))
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


def test_a_vehicle_that_is_silent_from_the_start_is_no_error() -> None:
    assert Stepped().step(heard_ns=-NS_PER_S) == NOTHING


@pytest.mark.parametrize("ends", ["stop", "duration"])
def test_watching_ends_as_a_flight_does(ends: str) -> None:
    stepped = Stepped(readonly=True, duration_ns=NS_PER_S if ends == "duration" else None)
    assert set(stepped.run(1)) == {FLIES}
    assert stepped.step(stop=DEATH if ends == "stop" else None) == NOTHING
    assert stepped.phase is Phase.ENDED


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


def left_by_fault() -> Stepped:
    stepped = flying(IDLE_RECEIVER)
    stepped.step(**FAULT)
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
        (asked, []),
        (
            lambda: flying(PX4),
            asking("AUTO.LOITER", (1000, 1100, 1200), (0, 20, 40, *range(100, 1251, 50))),
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
