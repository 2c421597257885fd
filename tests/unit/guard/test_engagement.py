"""Every row of the table in docs/SAFETY.md: engaging, and losing the sticks."""

from dataclasses import replace
from typing import Any

import pytest

from helpers.guard_facts import AIRBORNE, COPTER_MODES, ON_GROUND, Stepped, codes, flying
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import NEUTRAL
from mavbridge.guard.sequences import DisengageSettings
from mavbridge.guard.table import ACT_TIMEOUT_NS, PREPARE_TIMEOUT_NS
from mavbridge.guard.values import Actions, ControlSource, EndRequest, Outcome, Phase

NOTHING = Actions()
LOW, HIGH = (1500,) * 7 + (1000,), (1500,) * 7 + (2000,)
OLD_IMAGE = because(Code.TOO_OLD, quantity="image", age_ms=400.0, limit_ms=300.0)
READING = because(Code.READING_PARAMETERS)
TILT = because(Code.BEYOND, quantity="tilt", value=70.0, limit=60.0, unit="deg")
OVERRULED = because(Code.OVERRULED, quantity="sticks", cause="a joystick")


def wrong_mode(mode: str) -> Reason:
    return because(Code.WRONG_MODE, mode=mode, allowed="ALT_HOLD or ALTCTL")


def after_s(reason: Reason | None) -> Any:
    """The time that a vehicle was given to get ready."""
    assert reason is not None
    inner = dict(reason.data).get("why", reason)
    return dict(inner.data)["after_s"]


# --- engaging


def test_somebody_elses_arming_is_not_engaging() -> None:
    stepped = Stepped(ON_GROUND)
    assert set(stepped.run(1)) == {NOTHING}
    assert set(stepped.run(5, armed=True)) == {NOTHING}
    assert stepped.phase is Phase.WAITING


def test_arm_brings_the_vehicle_into_its_mode_arms_it_and_flies_once() -> None:
    stepped = Stepped(replace(ON_GROUND, mode="STABILIZE"), arm=True)
    assert stepped.step() == Actions(
        control=ControlSource.IDLE
    )  # until the vehicle shows our sticks
    assert stepped.step(echo_confirmed=True) == Actions(control=ControlSource.IDLE, mode="ALT_HOLD")
    stepped.run(1)
    assert stepped.step(mode="ALT_HOLD").mode is None
    assert Actions(control=ControlSource.IDLE, arm=True) in stepped.run(1.1)
    assert stepped.step(armed=True) == Actions(control=ControlSource.POLICY)
    assert stepped.phase is Phase.FLYING


def test_requests_are_a_second_apart() -> None:
    stepped = Stepped(replace(ON_GROUND, mode="STABILIZE"), arm=True)
    moves = stepped.run(10, echo_confirmed=True)
    assert sum(move.mode == "ALT_HOLD" for move in moves) == 10


def test_a_mode_of_the_flag_is_asked_for_even_where_another_would_do() -> None:
    stepped = Stepped(ON_GROUND, arm=True, mode="LOITER", modes=("ALT_HOLD", "LOITER"))
    assert stepped.step(echo_confirmed=True).mode == "LOITER"


def test_a_mode_that_the_vehicle_lacks_is_a_failure_at_once() -> None:
    stepped = Stepped(ON_GROUND, arm=True, mode="ALTCTL")
    stepped.run(0.1, is_released=True)
    assert stepped.phase is Phase.ENDED
    modes = ", ".join(COPTER_MODES.names)
    assert stepped.engagement.failure == because(Code.NO_SUCH_MODE, mode="ALTCTL", modes=modes)
    assert {move.mode for move in stepped.moves} == {None}


def test_in_the_air_nothing_is_sent_before_the_policy_flies() -> None:
    stepped = Stepped(replace(AIRBORNE, mode="LOITER"), mode="ALT_HOLD")
    stepped.step()
    assert stepped.step("engage") == Actions(mode="ALT_HOLD")
    assert stepped.step() == NOTHING
    assert stepped.step(mode="ALT_HOLD") == Actions(control=ControlSource.POLICY)


@pytest.mark.parametrize("reason", ["release", "stop", "time"])
def test_a_pilot_who_never_lost_the_sticks_keeps_them(reason: str) -> None:
    stepped = Stepped(replace(AIRBORNE, mode="LOITER", is_released=True), mode="ALT_HOLD")
    stepped.step()
    stepped.step("engage")
    before = len(stepped.moves)
    if reason == "stop":
        stepped.engagement.stop(EndRequest(reason=because(Code.FLIGHT_PROCESS_DIED), is_fault=True))
    stepped.run(PREPARE_TIMEOUT_NS / NS_PER_S + 1 if reason == "time" else 0)
    stepped.step("release" if reason == "release" else None)
    stepped.run(0.1)
    asked = [move for move in stepped.moves[before:] if move.mode not in (None, "ALT_HOLD")]
    assert not asked
    assert {move.control for move in stepped.moves} <= {None, ControlSource.RELEASE}
    assert stepped.phase in (Phase.RELEASED, Phase.ENDED)


def test_a_vehicle_that_does_not_get_ready_ends_it_with_a_reason() -> None:
    stepped = Stepped(ON_GROUND, arm=True)
    stepped.run(PREPARE_TIMEOUT_NS / NS_PER_S + 2)
    assert stepped.phase is Phase.ENDED
    assert codes(stepped.engagement.failure) == (Code.NOT_READY,)
    assert after_s(stepped.engagement.failure) == 90
    assert stepped.moves[-2].control is not ControlSource.IDLE


def test_a_policy_that_is_too_slow_is_refused_before_arming() -> None:
    stepped = Stepped(ON_GROUND, arm=True)
    slow = because(Code.TOO_SLOW, chunks=5, age_ms=300.0, limit_ms=100.0)
    stepped.run(
        2,
        echo_confirmed=True,
        chunk_problem=because(Code.TOO_OLD, quantity="chunk", age_ms=300.0, limit_ms=100.0),
        slowness=slow,
    )
    assert stepped.phase is Phase.ENDED
    assert stepped.engagement.failure == slow
    assert not any(move.arm for move in stepped.moves)


def test_one_that_is_disarmed_while_preparing_is_not_armed_again() -> None:
    stepped = Stepped(ON_GROUND, arm=True)
    stepped.run(0.5, echo_confirmed=True)
    stepped.step(armed=True, chunk_problem=because(Code.NO_IMAGE))
    stepped.step(armed=False, chunk_problem=None, is_released=True)
    assert not any(move.arm for move in stepped.run(5))
    assert Code.DISARMED in stepped.codes


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"armed": False}, because(Code.NOT_ARMED)),
        *(({"mode": mode}, wrong_mode(mode)) for mode in ("STABILIZE", "GUIDED", "RTL")),
        ({"chunk_problem": OLD_IMAGE}, OLD_IMAGE),
        ({"link_problem": READING}, READING),
        ({"is_failsafe": True}, because(Code.FAILSAFE, mode="ALT_HOLD")),
        ({"envelope_problem": TILT}, TILT),
    ],
)
def test_an_act_that_cannot_be_followed_is_refused_and_forgotten(
    changes: dict[str, Any], told: Reason
) -> None:
    stepped = Stepped(replace(AIRBORNE, **changes))
    stepped.step()
    assert stepped.step("engage") == NOTHING
    assert stepped.engagement.refusal == because(Code.NOT_ENGAGED_SINCE, why=told)
    good = {name: getattr(AIRBORNE, name) for name in changes}
    assert set(stepped.run(2, **good)) == {NOTHING}
    assert stepped.step("engage") == Actions(control=ControlSource.POLICY)


def test_the_switch_engages_by_going_high_while_armed_and_releases_by_going_low() -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=HIGH), engage_channel=8)
    assert set(stepped.run(1)) == {NOTHING}  # it was high from the start
    stepped.run(2, rc_channels_us=LOW)
    assert stepped.run(0.21, rc_channels_us=HIGH)[-1] == Actions(control=ControlSource.POLICY)
    assert stepped.step(rc_channels_us=LOW) == Actions(control=ControlSource.RELEASE)
    assert Code.ENGAGE_SWITCH_OFF in stepped.codes


def test_a_switch_that_was_never_high_needs_the_debounce_alone() -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=LOW), engage_channel=8)
    stepped.run(0.21)
    assert set(stepped.run(0.2, rc_channels_us=HIGH)) == {NOTHING}
    assert stepped.step() == Actions(control=ControlSource.POLICY)


LOST = (1500,) * 7
"""Channels without the switch's."""


@pytest.mark.parametrize("unused_us", [0, 1, 799, 2201, 2500, 32767, 40000, 65534, 65535])
@pytest.mark.parametrize("before", [LOW, HIGH])
def test_only_a_radios_range_is_a_reading(unused_us: int, before: tuple[int, ...]) -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=before), engage_channel=8)
    stepped.run(3)
    assert set(stepped.run(3, rc_channels_us=(*LOST, unused_us))) == {NOTHING}
    assert set(stepped.run(1, rc_channels_us=HIGH)) == {NOTHING}, "after a gap"
    stepped.run(2, rc_channels_us=LOW)
    assert Actions(control=ControlSource.POLICY) in stepped.run(0.3, rc_channels_us=HIGH)


@pytest.mark.parametrize("seconds", [0.02, 0.3, 0.6, 1.0, 1.5, 1.7])
@pytest.mark.parametrize("is_flying", [False, True])
def test_a_dropout_that_puts_the_switch_low_is_no_act(seconds: float, is_flying: bool) -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=HIGH), engage_channel=8)
    stepped.run(1)
    if is_flying:
        stepped.step("engage")
    first, *rest = stepped.run(seconds, rc_channels_us=LOW)
    assert first == (Actions(control=ControlSource.RELEASE) if is_flying else NOTHING), (
        "low is taken at its word"
    )
    assert {move.control for move in (*rest, *stepped.run(2, rc_channels_us=HIGH))} <= {
        None,
        ControlSource.RELEASE,
    }
    assert stepped.engagement.outcome.flights == is_flying


@pytest.mark.parametrize(
    "lost",
    [
        {"is_failsafe": True},
        {"is_receiver_sick": True},
        {"rc_channels_us": ()},
        {"rc_channels_us": LOW, "channels_ns": 1},
    ],
)
@pytest.mark.parametrize("again_s", [0.0, 0.3, 1.7])
def test_a_receiver_that_was_lost_has_to_show_the_switch_low_again(
    lost: dict[str, Any], again_s: float
) -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=LOW), engage_channel=8)
    stepped.run(3)
    stepped.run(0.6, **lost)
    well = {"is_failsafe": False, "is_receiver_sick": False, "channels_ns": None}
    stepped.run(again_s, rc_channels_us=LOW, **well)
    assert set(stepped.run(1, rc_channels_us=HIGH, **well)) == {NOTHING}
    assert codes(stepped.engagement.refusal) == (Code.NOT_ENGAGED_SINCE, Code.SWITCH_NOT_RESTED)
    stepped.run(2, rc_channels_us=LOW)
    assert Actions(control=ControlSource.POLICY) in stepped.run(0.3, rc_channels_us=HIGH)


def test_a_switch_that_bounces_is_no_act() -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=LOW), engage_channel=8)
    stepped.run(3)
    for _ in range(20):
        assert set(stepped.run(0.19, rc_channels_us=HIGH)) == {NOTHING}
        stepped.step(rc_channels_us=(1500,) * 8)


def test_the_dwell_counts_arrivals_and_not_the_time_that_an_old_value_stays() -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=LOW, channels_ns=0), engage_channel=8)
    stepped.run(0.45)
    now_ns = stepped.facts.now_ns
    assert set(stepped.run(0.45, rc_channels_us=HIGH, channels_ns=now_ns)) == {NOTHING}


def test_a_switch_that_went_high_while_disarmed_does_not_engage_later() -> None:
    stepped = Stepped(replace(ON_GROUND, rc_channels_us=LOW), engage_channel=8)
    stepped.run(0.3)
    stepped.run(0.3, rc_channels_us=HIGH)
    assert set(stepped.run(2, armed=True)) == {NOTHING}


def test_the_key_does_not_overrule_a_switch_that_is_off() -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=LOW), engage_channel=8)
    stepped.step()
    assert stepped.step("engage") == NOTHING
    off = because(Code.ENGAGE_SWITCH_OFF, channel=8)
    assert stepped.engagement.refusal == because(Code.NOT_ENGAGED_SINCE, why=off)


def test_engage_on_arm_counts_the_first_arming_alone() -> None:
    stepped = Stepped(ON_GROUND, engage_on_arm=True)
    stepped.run(0.1)
    assert stepped.step(armed=True) == Actions(control=ControlSource.POLICY)
    stepped.step(armed=False)
    stepped.run(2, is_released=True)
    assert set(stepped.run(2, armed=True)) == {NOTHING}


def test_a_vehicle_that_is_armed_when_it_is_found_was_not_armed_for_us() -> None:
    stepped = Stepped(engage_on_arm=True)
    assert set(stepped.run(2)) == {NOTHING}


# --- losing the sticks to somebody else: release in the same step, no mode command, latched

TAKEOVERS: list[tuple[dict[str, Any], Reason]] = [
    ({"mode": "LOITER"}, because(Code.MODE_CHANGED, before="ALT_HOLD", after="LOITER")),
    ({"armed": False}, because(Code.DISARMED)),
    ({"is_switched_off": True}, because(Code.OVERRIDE_SWITCH_OFF)),
    ({"overruled": OVERRULED}, OVERRULED),
    ({"interruption": because(Code.REBOOTED)}, because(Code.REBOOTED)),
    ({"is_failsafe": True, "mode": "RTL"}, because(Code.FAILSAFE, mode="RTL")),
]


@pytest.mark.parametrize(("changes", "told"), TAKEOVERS)
@pytest.mark.parametrize("on_fault", ["auto", "land"])
def test_a_takeover_releases_at_once_and_sends_no_mode(
    changes: dict[str, Any], told: Reason, on_fault: Any
) -> None:
    stepped = flying(disengage=DisengageSettings(on_fault=on_fault, then=on_fault))
    assert stepped.step(**changes) == Actions(control=ControlSource.RELEASE)
    assert stepped.engagement.reason == told
    moves = stepped.run(3, is_released=False)
    assert {move.mode for move in moves} == {None}
    assert moves[-1] == NOTHING
    assert stepped.phase is Phase.RELEASED


@pytest.mark.parametrize(("changes", "told"), TAKEOVERS)
def test_what_was_taken_comes_back_only_by_an_act(changes: dict[str, Any], told: Reason) -> None:
    stepped = flying()
    stepped.step(**changes)
    stepped.run(0.1, is_released=True)
    back = {name: getattr(AIRBORNE, name) for name in changes}
    back.pop("interruption", None)
    assert set(stepped.run(2, **back)) == {NOTHING}
    stepped.run(1, armed=False)
    assert set(stepped.run(1, armed=True)) == {NOTHING}  # disarming resets nothing
    assert stepped.engagement.reason == told
    assert stepped.step("engage") == Actions(control=ControlSource.POLICY)


def test_a_release_that_is_confirmed_ends_at_once() -> None:
    stepped = flying()
    stepped.step(mode="LOITER")
    assert stepped.step(is_released=True) == NOTHING
    assert stepped.phase is Phase.RELEASED


# --- our own faults and ends

FAULTS = [
    {"chunk_fault": because(Code.NO_CHUNK)},
    {"link_problem": because(Code.HEARTBEAT_LOST)},
    {"envelope_problem": TILT},
]


@pytest.mark.parametrize("changes", FAULTS)
def test_a_fault_is_neutral_in_the_same_step_then_a_safe_mode(changes: dict[str, Any]) -> None:
    stepped = flying(replace(AIRBORNE, pilot_sticks=NEUTRAL._replace(throttle=-1.0)))
    assert stepped.step(**changes) == Actions(control=ControlSource.NEUTRAL, mode="BRAKE")
    assert stepped.phase is Phase.LEAVING
    assert {move.control for move in stepped.run(0.05)} == {ControlSource.NEUTRAL}
    assert stepped.step(mode="BRAKE") == Actions(control=ControlSource.RELEASE)


@pytest.mark.parametrize("changes", FAULTS)
def test_inputs_that_come_back_do_not_fly_again(changes: dict[str, Any]) -> None:
    stepped = flying()
    stepped.step(**changes)
    stepped.run(1)
    back = dict.fromkeys(changes)
    moves = stepped.run(3, is_released=True, **back)
    assert moves[-1] == NOTHING
    assert all(move.control is not ControlSource.POLICY for move in moves)


def test_the_flight_process_dies() -> None:
    stepped = flying()
    stepped.engagement.stop(EndRequest(reason=because(Code.FLIGHT_PROCESS_DIED), is_fault=True))
    assert stepped.step().control is ControlSource.NEUTRAL
    stepped.run(0.1)
    stepped.step(is_released=True)
    stepped.step()
    assert stepped.phase is Phase.ENDED


def test_the_duration_counts_from_the_first_engagement() -> None:
    stepped = Stepped(duration_ns=NS_PER_S)
    stepped.run(3)
    stepped.step("engage")
    stepped.run(0.99)
    assert stepped.phase is Phase.FLYING
    assert stepped.step().control is ControlSource.NEUTRAL
    stepped.run(0.1, is_released=True)
    assert stepped.phase is Phase.ENDED


def test_the_duration_ends_it_also_after_a_takeover() -> None:
    stepped = flying(duration_ns=NS_PER_S)
    stepped.step(mode="LOITER")
    stepped.run(0.5, is_released=True)
    assert stepped.phase is Phase.RELEASED
    stepped.run(0.6)
    assert stepped.phase is Phase.ENDED


def test_the_operators_release_is_a_normal_end_and_the_guard_stays() -> None:
    stepped = flying()
    assert stepped.step("release").control is ControlSource.NEUTRAL
    stepped.run(1, is_released=True)
    assert stepped.phase is Phase.RELEASED
    assert stepped.step("engage").control is ControlSource.POLICY


def test_a_stop_before_any_flight_ends_without_a_word_to_the_vehicle() -> None:
    stepped = Stepped()
    stepped.engagement.stop(EndRequest(reason=because(Code.DURATION)))
    assert stepped.step() == NOTHING
    assert stepped.phase is Phase.ENDED


def test_readonly_flies_whenever_it_could_and_never_asks() -> None:
    stepped = Stepped(replace(AIRBORNE, armed=False, mode="RTL"), readonly=True)
    assert {move.control for move in stepped.run(1)} == {ControlSource.POLICY}
    assert stepped.step(chunk_problem=because(Code.NO_CHUNK)) == NOTHING
    assert stepped.step(chunk_problem=None).control is ControlSource.POLICY
    assert not any(move.arm or move.mode for move in stepped.moves)


# --- sequences that once went wrong


def test_a_takeover_releases_at_least_once_even_if_nothing_seems_to_be_held() -> None:
    stepped = flying()
    move = stepped.step(is_released=True, interruption=because(Code.REBOOTED))
    assert move == Actions(control=ControlSource.RELEASE)
    assert stepped.step() == Actions()
    assert stepped.phase is Phase.RELEASED


def test_a_takeover_in_the_very_step_of_a_fault_wins() -> None:
    stepped = flying(disengage=DisengageSettings(on_fault="hold"))
    move = stepped.step(mode="RTL", chunk_fault=because(Code.NO_CHUNK), envelope_problem=TILT)
    assert move == Actions(control=ControlSource.RELEASE)
    assert not any(move.mode for move in stepped.run(3))


def test_the_safe_mode_of_the_last_flight_is_the_pilots_in_the_next_one() -> None:
    stepped = flying(disengage=DisengageSettings(on_fault="hold"))
    stepped.step(chunk_fault=because(Code.NO_CHUNK))
    stepped.run(0.2, mode="BRAKE")
    stepped.run(1.5)
    stepped.step(mode="ALT_HOLD", chunk_fault=None)
    stepped.step("engage")
    assert stepped.phase is Phase.FLYING
    stepped.step(mode="BRAKE")
    assert stepped.phase is Phase.RELEASING


def test_an_act_that_waits_for_a_mode_is_given_up_soon_and_touches_no_stick() -> None:
    stepped = Stepped(
        replace(AIRBORNE, is_released=True), mode="LOITER", modes=("ALT_HOLD", "LOITER")
    )
    stepped.step()
    stepped.step("engage")
    assert stepped.moves[-1] == Actions(mode="LOITER")
    moves = stepped.run(ACT_TIMEOUT_NS / NS_PER_S + 1.5)
    assert {move.control for move in moves} <= {None, ControlSource.RELEASE}
    assert stepped.phase is Phase.RELEASED
    assert stepped.engagement.failure is None
    assert codes(stepped.engagement.refusal) == (Code.NOT_ENGAGED_SINCE, Code.NOT_READY)
    assert after_s(stepped.engagement.refusal) == 3


def test_a_pilots_mode_is_not_changed_back_while_ours_is_awaited() -> None:
    stepped = Stepped(mode="LOITER", modes=("ALT_HOLD", "LOITER"))
    stepped.step()
    stepped.step("engage")
    stepped.step(mode="LAND")
    assert stepped.phase is Phase.RELEASING
    assert not any(move.mode for move in stepped.run(3))


@pytest.mark.parametrize("phase", ["leaving", "releasing", "holding"])
def test_an_act_while_the_last_flight_ends_is_refused_aloud(phase: str) -> None:
    stepped = flying(
        replace(AIRBORNE, has_receiver=phase == "leaving", pilot_sticks=None),
        disengage=DisengageSettings(on_fault="hold"),
    )
    if phase == "releasing":
        stepped.step(mode="RTL")
    else:
        stepped.step(chunk_fault=because(Code.NO_CHUNK))
        stepped.run(0.2, mode="BRAKE" if phase == "holding" else "ALT_HOLD")
    assert stepped.phase.value == phase
    stepped.step("engage")
    still = because(Code.STILL_ENDING, phase=phase)
    assert stepped.engagement.refusal == because(Code.NOT_ENGAGED_SINCE, why=still)


# --- how it went


def test_a_flight_in_order_is_told_so() -> None:
    stepped = flying()
    stepped.run(1, is_landed=False)
    stepped.engagement.stop(EndRequest(reason=because(Code.COURSE_DONE), end="course"))
    stepped.run(1)
    expected = Outcome(flights=1, has_left_ground=True, end="course")
    assert stepped.engagement.outcome == expected


@pytest.mark.parametrize(
    ("changes", "ended"),
    [
        (
            {"chunk_fault": OLD_IMAGE},
            {"faults": 1, "end": "fault", "fault": OLD_IMAGE},
        ),
        ({"link_problem": READING}, {"faults": 1, "end": "fault", "fault": READING}),
        ({"armed": False}, {"is_disarmed": True, "end": "disarmed"}),
        ({"mode": "LOITER"}, {"end": "takeover"}),  # the pilot has taken over, and goes on
        ({"landing": because(Code.LANDED)}, {"end": "landed"}),
    ],
)
def test_how_a_flight_ended_is_told(changes: dict[str, Any], ended: dict[str, Any]) -> None:
    stepped = flying()
    stepped.run(0.1, is_landed=False)
    stepped.run(0.1, **changes)
    expected = Outcome(flights=1, has_left_ground=True)._replace(**ended)
    assert stepped.engagement.outcome == expected


def test_each_planned_end_has_its_code_until_the_next_flight() -> None:
    stepped = flying()
    stepped.step("release")
    assert stepped.engagement.outcome.end == "operator"
    stepped.run(2, is_released=True)
    stepped.step("engage")
    assert stepped.engagement.outcome.end is None
    stepped.engagement.stop(EndRequest(reason=because(Code.SIGNAL)))
    stepped.step()
    assert stepped.engagement.outcome.end == "signal"
    timed = flying(duration_ns=NS_PER_S)
    timed.run(1.1)
    assert timed.engagement.outcome.end == "duration"


def test_a_vehicle_that_stays_on_the_ground_is_told() -> None:
    stepped = flying()
    stepped.run(1, is_landed=True)
    stepped.run(1, is_landed=None)
    assert stepped.engagement.outcome.has_left_ground is False
    stepped.run(0.1, is_landed=False)
    assert stepped.engagement.outcome.has_left_ground is True
