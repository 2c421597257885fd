"""Single steps of the way in, each condition by itself."""

from dataclasses import replace
from typing import Any

from helpers.guard_facts import AIRBORNE, COPTER_MODES, ON_GROUND, PX4_MODES
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.guard.sequences import FLOW_NS, EngageSequence, EngageSettings
from mavbridge.guard.values import ControlSource, EngagementInputs

GROUND = replace(ON_GROUND, mode="STABILIZE", echo_confirmed=True)
NO_ECHO = because(Code.NO_ECHO, message="RC_CHANNELS", quantity="sticks")


def begun(
    facts: EngagementInputs, *, modes: tuple[str, ...] = ("ALT_HOLD", "LOITER"), **given: Any
) -> EngageSequence:
    preparation = EngageSequence(EngageSettings(modes=modes, **given))
    preparation.begin(facts)
    return preparation


def test_the_first_step_asks_at_once_and_the_second_a_second_later() -> None:
    preparation = begun(GROUND)
    assert preparation.step(GROUND, None).mode == "ALT_HOLD"
    just_before = replace(GROUND, now_ns=NS_PER_S - 1)
    assert preparation.step(just_before, None).mode is None
    assert preparation.step(replace(GROUND, now_ns=NS_PER_S), None).mode == "ALT_HOLD"


def test_an_objection_is_what_it_waits_for_and_nothing_is_asked() -> None:
    objection = because(Code.NO_CHUNK)
    preparation = begun(GROUND)
    move, waits_for = preparation.step(GROUND, objection), preparation.waits_for
    assert (move.control, move.mode, waits_for) == (ControlSource.IDLE, None, objection)


def test_a_mode_is_asked_of_an_armed_vehicle_that_shows_no_sticks_of_ours() -> None:
    facts = replace(AIRBORNE, mode="STABILIZE", echo_confirmed=False)
    assert begun(facts).step(facts, None).mode == "ALT_HOLD"
    on_ground = replace(GROUND, echo_confirmed=False)
    assert begun(on_ground).step(on_ground, None).mode is None


def test_one_that_we_armed_is_idle_until_the_policy_takes_it() -> None:
    preparation = begun(GROUND)
    ready = replace(GROUND, mode="ALT_HOLD", armed=True)
    assert preparation.step(ready, None) == preparation.step(ready, None)
    move, waits_for = preparation.step(ready, None), preparation.waits_for
    assert (move.control, waits_for) == (ControlSource.IDLE, None)
    # Silence while the link has a problem: it stands on the ground.
    assert preparation.step(replace(ready, link_problem=NO_ECHO), None).control is None


def test_which_mode_is_wanted() -> None:
    first = begun(GROUND)
    assert first.wanted_mode(GROUND) == "ALT_HOLD"
    assert first.wanted_mode(replace(GROUND, mode="LOITER")) is None
    nameless = replace(GROUND, modes=replace(COPTER_MODES, names=()))
    assert first.wanted_mode(nameless) == "ALT_HOLD"
    assert first.impossibility(nameless) is None
    assert begun(GROUND, mode="LOITER").wanted_mode(GROUND) == "LOITER"
    with_loiter_alone = replace(GROUND, modes=replace(COPTER_MODES, names=("LOITER",)))
    assert first.wanted_mode(with_loiter_alone) == "LOITER"


def test_the_modes_of_a_takeoff_are_our_own_only_if_we_take_off() -> None:
    in_guided = replace(AIRBORNE, mode="GUIDED")
    assert begun(GROUND, takeoff_m=8.0).is_own_mode(in_guided)
    assert not begun(GROUND).is_own_mode(in_guided)
    assert not begun(AIRBORNE, takeoff_m=8.0).is_own_mode(in_guided)


def test_one_that_is_found_in_the_air_does_not_take_off() -> None:
    preparation = begun(AIRBORNE, takeoff_m=8.0)
    assert preparation.is_up
    move = preparation.step(replace(AIRBORNE, link_problem=NO_ECHO), None)
    assert (move.control, move.takeoff_m) == (None, None)


def test_an_act_changes_the_mode_only_where_our_setpoints_are_needed_to_enter_it() -> None:
    loitering = replace(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES)
    setpoints = begun(loitering, modes=("OFFBOARD",), is_setpoint=True)
    assert setpoints.may_change_mode(loitering)
    assert not setpoints.may_change_mode(replace(loitering, mode="OFFBOARD"))
    assert not begun(loitering, modes=("ALTCTL",)).may_change_mode(loitering)


def test_the_setpoints_of_a_second_way_in_flow_as_long_as_those_of_the_first() -> None:
    facts = replace(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES)
    preparation = begun(facts, modes=("OFFBOARD",), is_setpoint=True)
    preparation.step(facts, None)
    asked = preparation.step(replace(facts, now_ns=FLOW_NS), None)
    assert (asked.control, asked.mode) == (ControlSource.NEUTRAL, "OFFBOARD")
    preparation.begin(facts)
    assert not preparation.is_own_mode(replace(facts, mode="OFFBOARD"))
    later = replace(facts, now_ns=FLOW_NS + 2 * NS_PER_S)
    assert preparation.step(later, None).mode is None


def test_setpoints_flow_only_for_a_mode_that_takes_them() -> None:
    facts = replace(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES)
    preparation = begun(facts, modes=("POSCTL",), is_setpoint=True)
    assert preparation.step(facts, None).control is None


# --- the autopilot's takeoff


def test_the_climb_is_asked_for_in_the_step_that_sees_it_armed() -> None:
    preparation = begun(replace(GROUND, mode="GUIDED"), takeoff_m=10.0)
    armed = replace(GROUND, mode="GUIDED", armed=True)
    move, waits_for = preparation.step(armed, None), preparation.waits_for
    told = because(Code.TAKING_OFF, height_m=10.0)
    assert (move.control, move.takeoff_m, waits_for) == (ControlSource.NEUTRAL, 10.0, told)


def test_a_climb_that_has_begun_is_not_asked_for_again() -> None:
    preparation = begun(replace(GROUND, mode="GUIDED"), takeoff_m=10.0)
    climbing = replace(GROUND, mode="GUIDED", armed=True, is_landed=False)
    move = preparation.step(climbing, None)
    assert (move.control, move.takeoff_m) == (ControlSource.NEUTRAL, None)


def test_nine_tenths_of_the_height_are_enough_and_count_from_where_it_stood() -> None:
    preparation = begun(replace(GROUND, mode="GUIDED"), takeoff_m=10.0)
    for height_m in (0.0, -3.0):  # it drifts as long as it stands
        preparation.step(replace(GROUND, mode="GUIDED", height_m=height_m), None)
    climbing = replace(GROUND, mode="GUIDED", armed=True, is_landed=False, height_m=5.5)
    preparation.step(climbing, None)
    assert not preparation.is_up
    preparation.step(replace(climbing, height_m=6.0), None)
    assert preparation.is_up


def test_a_climb_whose_height_is_lost_for_a_moment_goes_on() -> None:
    preparation = begun(replace(GROUND, mode="GUIDED"), takeoff_m=10.0)
    climbing = replace(GROUND, mode="GUIDED", armed=True, height_m=None)
    preparation.step(climbing, None)
    assert preparation.waits_for == because(Code.TAKEOFF_NEEDS_POSITION)
    assert not preparation.is_up


def test_without_a_takeoff_no_height_is_needed() -> None:
    facts = replace(GROUND, mode="ALT_HOLD", height_m=None)
    preparation = begun(facts)
    preparation.step(facts, None)
    assert preparation.waits_for == because(Code.WAITING_FOR_ARMING)


def test_the_mode_in_which_it_climbs_is_left_to_the_autopilot() -> None:
    climbing = replace(GROUND, armed=True, mode="AUTO.TAKEOFF", modes=PX4_MODES)
    preparation = begun(replace(GROUND, modes=PX4_MODES), takeoff_m=10.0)
    assert preparation.wanted_mode(climbing) is None


def test_no_setpoint_flows_in_a_climb_even_where_the_mode_would_take_it() -> None:
    preparation = begun(GROUND, takeoff_m=10.0, is_setpoint=True, modes=("OFFBOARD",))
    climbing = replace(GROUND, armed=True, mode="OFFBOARD", modes=PX4_MODES)
    assert preparation.step(climbing, None).control is None
    without_link = replace(climbing, link_problem=NO_ECHO)
    assert preparation.step(without_link, None).control is None
