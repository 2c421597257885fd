"""The engagement at its limits of time, and where two things happen in one step."""

from dataclasses import replace
from typing import Any

import pytest

from helpers.guard_facts import AIRBORNE, ON_GROUND, PX4_MODES, Stepped, flying
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, Reason, because
from mavbridge.core.vehicle import NEUTRAL
from mavbridge.guard.sequences import DisengageSettings
from mavbridge.guard.values import Actions, ControlSource, EndRequest, Outcome, Phase

NOTHING = Actions()
LOW, HIGH = (1500,) * 7 + (1000,), (1500,) * 7 + (2000,)
NO_RECEIVER = replace(AIRBORNE, has_receiver=False, pilot_sticks=None)
FAULT = {"chunk_fault": because(Code.NO_CHUNK)}
REBOOTED = {"interruption": because(Code.REBOOTED), "interruptions": 1}
OVER = EndRequest(reason=because(Code.DURATION))


def changed(before: str, after: str) -> Reason:
    return because(Code.MODE_CHANGED, before=before, after=after)


def held_until(taken: Reason) -> Reason:
    """Of a vehicle that was ``holding``."""
    return because(Code.THEN, first=FAULT["chunk_fault"], then=taken)


def holding(**settings: Any) -> Stepped:
    """After a fault without a receiver, in BRAKE; the fault is over."""
    stepped = flying(NO_RECEIVER, **settings)
    stepped.step(**FAULT)
    stepped.run(0.2, mode="BRAKE", chunk_fault=None)
    assert stepped.phase is Phase.HOLDING
    return stepped


# --- the engage switch and the first arming


@pytest.mark.parametrize(
    ("low_us", "high_us", "engages"),
    [
        (1199, 1801, True),
        (800, 2200, True),
        (1, 1801, False),  # no reading of a radio
        (1199, 2201, False),
        (1200, 1801, False),
        (1199, 1800, False),
        (0, 2000, False),  # a channel that the receiver does not have
    ],
)
def test_the_switch_engages_from_below_1200_to_above_1800(
    low_us: int, high_us: int, engages: bool
) -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=(low_us,)), engage_channel=1)
    stepped.run(0.3)
    stepped.run(0.3, rc_channels_us=(high_us,))
    assert (stepped.phase is Phase.FLYING) == engages


def test_a_switch_on_a_channel_that_does_not_arrive_is_not_off() -> None:
    stepped = Stepped(engage_channel=9)
    stepped.step()
    assert stepped.step("engage") == Actions(control=ControlSource.POLICY)


def test_a_switch_engages_once_each_time_it_goes_high() -> None:
    stepped = Stepped(replace(AIRBORNE, rc_channels_us=LOW), engage_channel=8)
    stepped.run(0.3)
    stepped.run(0.3, rc_channels_us=HIGH)
    stepped.step(mode="LOITER")
    stepped.run(0.1, is_released=True)
    assert set(stepped.run(1, mode="ALT_HOLD")) == {NOTHING}
    stepped.run(2, rc_channels_us=LOW)
    assert Actions(control=ControlSource.POLICY) in stepped.run(0.3, rc_channels_us=HIGH)


@pytest.mark.parametrize("way", ["switch", "arming"])
def test_the_key_that_releases_wins_over_what_would_engage_in_the_same_step(way: str) -> None:
    stepped = Stepped(
        replace(AIRBORNE, armed=way == "switch", rc_channels_us=LOW if way == "switch" else HIGH),
        engage_channel=8,
        engage_on_arm=True,
    )
    stepped.run(0.3)
    if way == "switch":
        stepped.run(0.2, rc_channels_us=HIGH)
    assert stepped.step("release", armed=True, rc_channels_us=HIGH) == NOTHING
    assert set(stepped.run(1)) == {NOTHING}


def test_while_the_first_arming_is_awaited_nothing_is_asked_for() -> None:
    stepped = Stepped(ON_GROUND, engage_on_arm=True)
    stepped.run(0.1)
    assert stepped.engagement.refusal is None


def test_a_vehicle_that_appears_armed_has_not_been_armed_for_us() -> None:
    stepped = Stepped(replace(ON_GROUND, is_connected=False), engage_on_arm=True)
    stepped.run(0.1)
    assert set(stepped.run(1, is_connected=True, armed=True)) == {NOTHING}


def test_a_switch_that_goes_low_on_the_way_out_changes_nothing() -> None:
    stepped = Stepped(replace(NO_RECEIVER, rc_channels_us=LOW), engage_channel=8)
    stepped.run(0.3)
    stepped.run(0.3, rc_channels_us=HIGH)
    stepped.step(**FAULT)
    assert stepped.step(rc_channels_us=LOW).control is ControlSource.NEUTRAL
    assert stepped.phase is Phase.LEAVING


# --- waiting and preparing


def test_arming_waits_for_the_link() -> None:
    stepped = Stepped(replace(ON_GROUND, link_problem=because(Code.READING_PARAMETERS)), arm=True)
    assert set(stepped.run(1)) == {NOTHING}
    assert (stepped.phase, stepped.codes) == (Phase.WAITING, (Code.READING_PARAMETERS,))
    stepped.step(link_problem=None)
    assert stepped.phase is Phase.PREPARING


def test_while_it_waits_it_says_what_for() -> None:
    stepped = Stepped(
        replace(
            AIRBORNE,
            link_problem=because(Code.HEARTBEAT_LOST),
            chunk_problem=because(Code.NO_IMAGE),
        )
    )
    assert stepped.codes == (Code.NOT_ENGAGED,)
    stepped.step()
    assert stepped.codes == (Code.HEARTBEAT_LOST,)
    stepped.step(link_problem=None)
    assert stepped.codes == (Code.NO_IMAGE,)
    stepped.step(chunk_problem=None)
    assert stepped.codes == (Code.NOT_ENGAGED,)


def test_after_a_takeover_the_reason_of_it_stays() -> None:
    stepped = flying()
    stepped.step(mode="LOITER")
    stepped.run(0.2, is_released=True, chunk_problem=because(Code.NO_IMAGE))
    assert stepped.engagement.reason == changed("ALT_HOLD", "LOITER")


def test_arm_arms_once() -> None:
    stepped = Stepped(ON_GROUND, arm=True)
    stepped.run(0.1)
    stepped.step("release")
    stepped.run(0.1, is_released=True)
    assert stepped.phase is Phase.RELEASED
    assert stepped.codes == (Code.OPERATOR,)
    assert set(stepped.run(3, echo_confirmed=True)) == {NOTHING}


def test_a_stop_keeps_a_vehicle_from_being_armed() -> None:
    stepped = Stepped(ON_GROUND, arm=True)
    stepped.engagement.stop(OVER)
    assert stepped.step() == NOTHING
    assert stepped.phase is Phase.ENDED


def test_the_first_stop_is_the_one_that_counts() -> None:
    stepped = flying(NO_RECEIVER, disengage=DisengageSettings(on_fault="rtl", then="land"))
    stepped.engagement.stop(OVER)
    stepped.engagement.stop(EndRequest(reason=because(Code.FLIGHT_PROCESS_DIED), is_fault=True))
    assert stepped.step().mode == "LAND"
    assert stepped.codes == (Code.DURATION,)


@pytest.mark.parametrize(("takeoff_m", "limit_s"), [(None, 90), (100.0, 190)])
def test_the_way_in_may_take_90_s_and_the_time_of_a_climb_at_1_mps(
    takeoff_m: float | None, limit_s: int
) -> None:
    stepped = Stepped(
        replace(ON_GROUND, chunk_problem=because(Code.NO_IMAGE)), arm=True, takeoff_m=takeoff_m
    )
    stepped.run(limit_s + 0.01)
    assert stepped.phase is Phase.PREPARING
    stepped.step()
    assert stepped.phase is Phase.RELEASING
    assert stepped.engagement.failure == because(
        Code.NOT_READY,
        after_s=limit_s,
        mode="ALT_HOLD",
        is_armed=False,
        is_echoed=False,
        inputs=because(Code.NO_IMAGE),
    )


def test_a_vehicle_that_is_armed_and_not_ready_in_time_is_left_as_after_a_fault() -> None:
    stepped = Stepped(ON_GROUND, arm=True, disengage=DisengageSettings(on_fault="rtl", then="land"))
    stepped.run(0.1, echo_confirmed=True)
    stepped.run(89.9, armed=True, chunk_problem=because(Code.NO_IMAGE))
    assert stepped.phase is Phase.PREPARING
    moves = stepped.run(0.2)
    assert {"RTL", None} == {move.mode for move in moves}
    assert Code.NO_IMAGE in stepped.codes
    stepped.run(3, mode="RTL", is_released=True)
    assert stepped.phase is Phase.ENDED
    assert stepped.engagement.outcome == Outcome(), "the policy never flew"


@pytest.mark.parametrize(
    "changes",
    [
        {"mode": "LOITER"},  # somebody turns the mode switch of a vehicle that is disarmed
        {"is_failsafe": True},  # its radio failsafe on the ground
    ],
)
def test_what_happens_to_a_disarmed_vehicle_is_no_takeover(changes: dict[str, Any]) -> None:
    stepped = Stepped(replace(ON_GROUND, mode="STABILIZE"), arm=True)
    stepped.run(0.1)
    stepped.run(0.1, **changes)
    assert stepped.phase is Phase.PREPARING


def test_a_mode_that_is_changed_once_ours_is_there_is_a_takeover_although_disarmed() -> None:
    stepped = Stepped(ON_GROUND, arm=True)
    stepped.run(0.1)
    stepped.step(mode="LOITER")
    assert stepped.phase is Phase.RELEASING
    assert stepped.engagement.reason == changed("ALT_HOLD", "LOITER")
    assert stepped.engagement.outcome == Outcome(), "no flight has ended disarmed"


def test_sticks_that_idled_on_the_ground_are_released_although_none_seems_to_be_held() -> None:
    stepped = Stepped(replace(ON_GROUND, is_released=True), arm=True)
    stepped.run(0.1)
    assert stepped.step("release") == Actions(control=ControlSource.RELEASE)


def test_an_interruption_before_the_act_is_forgotten_one_after_it_is_not() -> None:
    stepped = Stepped(replace(ON_GROUND, **REBOOTED), arm=True)
    stepped.run(0.1, echo_confirmed=True)
    assert stepped.phase is Phase.PREPARING
    stepped.step(armed=True)
    assert stepped.step().control is ControlSource.POLICY
    assert stepped.step(interruption=because(Code.REBOOTED)) == Actions(
        control=ControlSource.RELEASE
    )
    assert stepped.codes == (Code.REBOOTED,)


def test_in_the_air_too_an_interruption_before_the_act_is_forgotten() -> None:
    stepped = flying(replace(AIRBORNE, **REBOOTED))
    assert {move.control for move in stepped.run(0.1)} == {ControlSource.POLICY}


def test_sticks_that_were_never_ours_are_not_released() -> None:
    stepped = Stepped(replace(AIRBORNE, mode="LOITER", is_released=True), mode="ALT_HOLD")
    stepped.step()
    stepped.step("engage")
    assert stepped.step("release") == NOTHING
    assert (stepped.phase, stepped.codes) == (Phase.RELEASED, (Code.OPERATOR,))


def test_a_pilot_who_has_armed_it_and_changes_the_mode_meanwhile_keeps_it() -> None:
    stepped = Stepped(replace(AIRBORNE, mode="LOITER", is_released=True), mode="ALT_HOLD")
    stepped.step()
    stepped.step("engage")
    assert stepped.step(mode="STABILIZE") == NOTHING
    assert stepped.engagement.reason == changed("LOITER", "STABILIZE")


def test_a_stop_while_preparing_is_told_and_followed_as_what_it_is() -> None:
    stepped = Stepped(ON_GROUND, arm=True, disengage=DisengageSettings(on_fault="rtl", then="land"))
    stepped.run(0.1, echo_confirmed=True)
    stepped.step(armed=True, chunk_problem=because(Code.NO_IMAGE))
    stepped.engagement.stop(EndRequest(reason=because(Code.FLIGHT_PROCESS_DIED), is_fault=True))
    assert stepped.step().mode == "RTL"
    assert stepped.codes == (Code.FLIGHT_PROCESS_DIED,)


def test_a_reboot_while_preparing_is_told_as_one_although_it_disarms() -> None:
    stepped = Stepped(ON_GROUND, arm=True)
    stepped.run(0.1, echo_confirmed=True)
    stepped.step(armed=True, chunk_problem=because(Code.NO_IMAGE))
    stepped.step(armed=False, interruption=because(Code.REBOOTED))
    assert stepped.codes == (Code.REBOOTED,)


# --- flying


def test_while_the_policy_flies_there_is_no_reason_why_not() -> None:
    stepped = flying()
    assert stepped.codes == ()


def test_a_vehicle_that_has_landed_again_has_left_the_ground() -> None:
    stepped = flying()
    stepped.run(0.1, is_landed=False)
    stepped.run(0.1, is_landed=True)
    assert stepped.engagement.outcome.has_left_ground is True


def test_a_signal_after_the_duration_is_over_does_not_begin_the_way_out_again() -> None:
    stepped = flying(NO_RECEIVER, duration_ns=NS_PER_S)
    stepped.run(1)
    stepped.run(0.2, mode="LAND")
    assert stepped.phase is Phase.HOLDING
    stepped.engagement.stop(EndRequest(reason=because(Code.SIGNAL)))
    assert {(move.control, move.mode) for move in stepped.run(0.2)} == {
        (ControlSource.NEUTRAL, None)
    }
    assert (stepped.phase, stepped.codes) == (Phase.HOLDING, (Code.DURATION,))


def test_each_flight_and_each_fault_counts() -> None:
    stepped = flying()
    for flights in (1, 2):
        stepped.step(**FAULT)
        stepped.run(0.2, chunk_fault=None, is_released=True)
        assert stepped.engagement.outcome.faults == flights
        assert stepped.step("engage").control is ControlSource.POLICY
        assert stepped.engagement.outcome.flights == flights + 1


def test_a_flight_that_ended_disarmed_is_forgotten_with_the_next_one() -> None:
    stepped = flying()
    stepped.step(armed=False)
    assert stepped.engagement.outcome.is_disarmed
    stepped.run(0.2, armed=True, is_released=True)
    stepped.step("engage")
    assert not stepped.engagement.outcome.is_disarmed


def test_a_disarming_on_the_way_out_is_how_it_should_end() -> None:
    stepped = holding()
    stepped.step(armed=False)
    assert stepped.phase is Phase.RELEASING
    assert not stepped.engagement.outcome.is_disarmed


def test_the_duration_goes_on_through_takeovers() -> None:
    stepped = flying(duration_ns=NS_PER_S)
    stepped.run(0.5)
    stepped.step(mode="LOITER")
    stepped.run(0.1, is_released=True, mode="ALT_HOLD")
    stepped.step("engage")
    stepped.run(0.37)
    assert stepped.phase is Phase.FLYING
    assert stepped.step().control is ControlSource.NEUTRAL
    assert stepped.codes == (Code.DURATION,)


def test_a_landing_ends_it_in_order_and_the_next_act_flies_again() -> None:
    stepped = flying(disengage=DisengageSettings(on_fault="rtl", then="land"))
    assert stepped.step(landing=because(Code.LANDED)).mode == "LAND"
    assert stepped.codes == (Code.LANDED,)
    assert stepped.engagement.outcome.faults == 0
    stepped.run(0.2, mode="LAND", landing=None, is_released=True)
    assert stepped.phase is Phase.RELEASED


def test_a_stop_after_a_fault_of_another_process_counts_as_a_fault() -> None:
    stepped = flying()
    stepped.engagement.stop(EndRequest(reason=because(Code.FLIGHT_PROCESS_DIED), is_fault=True))
    stepped.step()
    assert stepped.engagement.outcome.faults == 1
    assert stepped.codes == (Code.FLIGHT_PROCESS_DIED,)


# --- leaving, holding, releasing


def test_a_stop_on_the_way_out_waits_for_it_and_then_ends_it() -> None:
    stepped = flying()
    stepped.step(**FAULT)
    stepped.engagement.stop(OVER)
    assert stepped.step().control is ControlSource.NEUTRAL
    stepped.run(0.2, is_released=True)
    assert stepped.phase is Phase.ENDED


def test_the_stop_that_began_the_way_out_does_not_begin_it_again() -> None:
    stepped = flying(NO_RECEIVER)
    stepped.engagement.stop(OVER)
    stepped.step()
    stepped.run(0.2, mode="LAND")
    assert stepped.phase is Phase.HOLDING
    assert {(move.control, move.mode) for move in stepped.run(1)} == {(ControlSource.NEUTRAL, None)}
    assert stepped.phase is Phase.HOLDING


def test_the_operators_release_on_the_way_out_does_not_begin_it_again() -> None:
    stepped = flying(disengage=DisengageSettings(on_fault="rtl", then="land"))
    stepped.step(**FAULT)
    assert stepped.step("release").mode is None
    assert stepped.codes == (Code.NO_CHUNK,)


def test_a_vehicle_is_lost_after_30_s_without_a_word_while_held() -> None:
    stepped = holding()
    stepped.run(40, link_problem=because(Code.CALIBRATION_CHANGED))
    assert stepped.phase is Phase.HOLDING, "it is heard"
    stepped.run(30.2, heard_ns=stepped.facts.now_ns)
    assert stepped.phase is Phase.HOLDING
    assert stepped.run(0.1)[-1].control is ControlSource.RELEASE
    assert stepped.engagement.reason == held_until(because(Code.VEHICLE_LOST, after_s=30))


def test_who_takes_a_vehicle_that_was_just_given_up_is_told() -> None:
    stepped = holding()
    stepped.run(29.99, link_problem=because(Code.HEARTBEAT_LOST))
    stepped.step(mode="LOITER")
    assert stepped.engagement.reason == held_until(changed("BRAKE", "LOITER"))


def test_the_mode_that_was_asked_for_and_comes_late_is_no_takeover_of_the_way_out() -> None:
    stepped = Stepped(replace(ON_GROUND, mode="STABILIZE"), arm=True)
    stepped.run(0.1, echo_confirmed=True)
    stepped.step(armed=True)  # by somebody, in the mode that it was in
    stepped.step("release")
    stepped.step(mode="ALT_HOLD")
    assert stepped.phase is Phase.LEAVING


def test_why_it_was_held_and_who_took_it_are_both_told() -> None:
    stepped = holding()
    stepped.step(mode="LOITER", link_problem=None)
    assert stepped.engagement.reason == held_until(changed("BRAKE", "LOITER"))


def test_a_mode_that_was_confirmed_is_not_told_to_be_unconfirmed() -> None:
    stepped = holding()
    stepped.run(4)
    assert stepped.engagement.refusal is None
    unasked = flying(replace(AIRBORNE, pilot_sticks=NEUTRAL))
    unasked.step(**FAULT)
    unasked.run(0.2, is_released=True)
    assert unasked.engagement.refusal is None


def test_a_mode_that_was_not_confirmed_is_told_once() -> None:
    stepped = flying(NO_RECEIVER)
    stepped.step(**FAULT)
    stepped.run(3.1)
    assert stepped.phase is Phase.HOLDING
    assert stepped.engagement.refusal == because(Code.MODE_NOT_CONFIRMED, mode="BRAKE")
    stepped.engagement.refusal = None
    stepped.run(1)
    assert stepped.engagement.refusal is None


def test_going_back_from_the_safe_mode_to_the_policys_is_a_takeover() -> None:
    stepped = holding()
    assert stepped.step(mode="ALT_HOLD") == Actions(control=ControlSource.RELEASE)
    assert stepped.engagement.reason == held_until(changed("BRAKE", "ALT_HOLD"))


@pytest.mark.parametrize(("shows_last", "limit_s"), [(True, 1), (False, 4)])
def test_a_release_is_repeated_until_it_shows_or_for_so_long(
    shows_last: bool, limit_s: int
) -> None:
    stepped = flying(replace(AIRBORNE, shows_last=shows_last))
    stepped.step(mode="LOITER")
    assert {move.control for move in stepped.run(limit_s - 0.01)} == {ControlSource.RELEASE}
    assert stepped.step() == NOTHING
    assert stepped.phase is Phase.RELEASED
    assert stepped.engagement.refusal == because(Code.RELEASE_NOT_SEEN)


def test_a_release_that_is_confirmed_is_told_without_doubt() -> None:
    stepped = flying()
    stepped.step(mode="LOITER")
    stepped.run(0.1, is_released=True)
    assert stepped.engagement.refusal is None


def test_while_it_is_released_nothing_ends_it_sooner() -> None:
    stepped = flying()
    stepped.step(mode="LOITER")
    stepped.engagement.stop(OVER)
    assert stepped.step().control is ControlSource.RELEASE
    stepped.step(is_released=True)
    stepped.step()
    assert stepped.phase is Phase.ENDED


# --- setpoints, which go on if nobody sends any more

OFFBOARD: dict[str, Any] = {
    "is_setpoint": True,
    "modes": ("OFFBOARD",),
    "disengage": DisengageSettings(is_setpoint=True, on_fault="land", then="rtl"),
}
IN_OFFBOARD = replace(AIRBORNE, mode="OFFBOARD", modes=PX4_MODES)


def test_a_takeover_in_a_mode_of_setpoints_is_left_as_after_a_fault_and_told_once() -> None:
    stepped = flying(IN_OFFBOARD, **OFFBOARD)
    move = stepped.step(interruption=because(Code.REPLACED, said="another address"))
    assert move == Actions(control=ControlSource.NEUTRAL, mode="AUTO.LAND")
    assert (stepped.phase, stepped.codes) == (Phase.LEAVING, (Code.REPLACED,))
    assert stepped.step().control is ControlSource.NEUTRAL
    assert stepped.engagement.outcome.faults == 0


def test_in_a_mode_that_follows_no_setpoints_a_takeover_is_silence() -> None:
    stepped = flying(replace(IN_OFFBOARD, mode="POSCTL"), **{**OFFBOARD, "modes": ("POSCTL",)})
    assert stepped.step(interruption=because(Code.REPLACED, said="another address")) == Actions(
        control=ControlSource.RELEASE
    )


def test_an_act_in_a_mode_of_setpoints_that_is_late_is_left_as_after_a_fault() -> None:
    stepped = Stepped(replace(IN_OFFBOARD, mode="AUTO.LOITER"), **OFFBOARD)
    stepped.step()
    stepped.step("engage")
    stepped.run(0.2)
    stepped.step(mode="OFFBOARD", chunk_problem=because(Code.NO_IMAGE))
    stepped.run(3)
    assert "AUTO.LAND" in {move.mode for move in stepped.moves}
    assert "AUTO.RTL" not in {move.mode for move in stepped.moves}
    assert stepped.engagement.reason == stepped.engagement.refusal
    assert stepped.engagement.failure is None


# --- read-only


@pytest.mark.parametrize("ends", ["stop", "duration"])
def test_watching_ends_as_a_flight_does(ends: str) -> None:
    stepped = Stepped(readonly=True, duration_ns=NS_PER_S if ends == "duration" else None)
    assert {move.control for move in stepped.run(1)} == {ControlSource.POLICY}
    if ends == "stop":
        stepped.engagement.stop(OVER)
    assert stepped.step() == NOTHING
    assert stepped.phase is Phase.ENDED


def test_watching_tells_why_the_policy_could_not_fly() -> None:
    stepped = Stepped(replace(AIRBORNE, chunk_problem=because(Code.NO_IMAGE)), readonly=True)
    stepped.step()
    assert (stepped.phase, stepped.codes) == (Phase.WAITING, (Code.NO_IMAGE,))
    stepped.run(0.1, chunk_problem=None)
    assert (stepped.phase, stepped.codes) == (Phase.FLYING, ())
    assert stepped.engagement.outcome.flights == 1
