"""The way into a flight: mode, arming, takeoff by the autopilot, setpoints that flow first."""

from dataclasses import replace
from typing import Any

import pytest

from helpers.guard_facts import AIRBORNE, COPTER_MODES, ON_GROUND, PX4_MODES, Stepped, altered
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.guard.sequences import FLOW_NS, EngageSequence
from mavbridge.guard.values import (
    ControlSource,
    EngagementInputs,
    EngagementOutput,
    EngagementSettings,
    Phase,
)

IDLE, POLICY, NEUTRAL, LEVEL, RELEASE = ControlSource
GROUND = altered(ON_GROUND, mode="STABILIZE", modes=COPTER_MODES, echo_confirmed=True)
NO_ECHO = because(Code.NO_ECHO, message="RC_CHANNELS", quantity="sticks")
PX4_GROUND = altered(GROUND, mode="AUTO.LOITER", modes=PX4_MODES)


def requests(moves: list[EngagementOutput]) -> list[str]:
    """Everything that was asked for, in order."""
    asked: list[str] = []
    for move in moves:
        asked += [f"mode {move.mode}"] if move.mode else []
        asked += ["arm"] if move.arm else []
        asked += [f"climb {move.takeoff_m:g}"] if move.takeoff_m else []
    return asked


def test_the_autopilot_takes_off_before_sticks_fly() -> None:
    stepped = Stepped(GROUND, arm=True, takeoff_m=8.0)
    assert requests(stepped.run(0.5)) == ["mode GUIDED"]
    assert requests(stepped.run(1.0, mode="GUIDED")) == ["arm"]
    assert {move.control for move in stepped.moves} == {IDLE}
    climbing = stepped.run(2.5, armed=True)
    assert requests(climbing) == ["climb 8"] * 2
    assert {move.control for move in climbing} == {NEUTRAL}
    assert requests(stepped.run(2.0, is_landed=False, height_m=4.0)) == []
    assert stepped.engagement.reason == because(Code.TAKING_OFF, height_m=8)
    assert requests(stepped.run(0.5, height_m=7.3)) == ["mode ALT_HOLD"]
    stepped.step(mode="ALT_HOLD")
    assert stepped.phase is Phase.FLYING
    assert stepped.step(mode="GUIDED").control is RELEASE, "it was ours for the takeoff alone"


def test_px4_takes_off_through_its_own_modes_and_gets_setpoints_before_offboard() -> None:
    stepped = Stepped(
        PX4_GROUND, arm=True, takeoff_m=5.0, is_setpoint=True, modes=("GUIDED", "OFFBOARD")
    )
    assert requests(stepped.run(0.1)) == ["arm"]
    assert requests(stepped.run(1.0, armed=True)) == ["climb 5"]
    stepped.run(2.0, mode="AUTO.TAKEOFF", is_landed=False, height_m=3.0)
    stepped.step(height_m=4.9)
    entering = stepped.run(0.3, mode="AUTO.LOITER")
    assert requests(stepped.moves[-31:]) == ["mode OFFBOARD"]
    assert {move.control for move in entering} == {NEUTRAL}
    stepped.step(mode="OFFBOARD")
    assert stepped.phase is Phase.FLYING


# --- single steps, each condition by itself


def begun(
    facts: EngagementInputs, *, modes: tuple[str, ...] = ("ALT_HOLD", "LOITER"), **given: Any
) -> EngageSequence:
    sequence = EngageSequence(EngagementSettings(modes=modes, **given))
    sequence.begin(facts)
    return sequence


def test_the_first_step_asks_at_once_and_the_second_a_second_later() -> None:
    sequence = begun(GROUND)
    assert sequence.step(GROUND, None).mode == "ALT_HOLD"
    assert sequence.waits_for == because(Code.WAITING_FOR_MODE, mode="ALT_HOLD")
    just_before = altered(GROUND, now_ns=NS_PER_S - 1)
    assert sequence.step(just_before, None).mode is None
    assert sequence.step(altered(GROUND, now_ns=NS_PER_S), None).mode == "ALT_HOLD"


IN_STABILIZE = altered(AIRBORNE, mode="STABILIZE", echo_confirmed=False)
LOITERING = altered(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES)
IN_GUIDED = altered(GROUND, mode="GUIDED")
ARMED = {"mode": "ALT_HOLD", "armed": True}
CLIMB: dict[str, Any] = {"takeoff_m": 10.0}
SETPOINTS: dict[str, Any] = {"is_setpoint": True, "modes": ("OFFBOARD",)}
IN_OFFBOARD = {"armed": True, "mode": "OFFBOARD", "modes": PX4_MODES}


@pytest.mark.parametrize(
    ("begin", "given", "changes", "control", "asked", "waits_for"),
    [
        (GROUND, {}, {}, IDLE, ["mode ALT_HOLD"], Code.WAITING_FOR_MODE),
        (GROUND, {}, {"echo_confirmed": False}, IDLE, [], Code.WAITING_FOR_MODE),
        (IN_STABILIZE, {}, {}, None, ["mode ALT_HOLD"], Code.WAITING_FOR_MODE),
        (
            GROUND,
            {},
            {"mode": "ALT_HOLD", "height_m": None},
            IDLE,
            ["arm"],
            Code.WAITING_FOR_ARMING,
        ),
        (GROUND, {}, ARMED, IDLE, [], None),
        (GROUND, {}, {**ARMED, "problem": NO_ECHO}, None, [], Code.NO_ECHO),
        (AIRBORNE, CLIMB, {"problem": NO_ECHO}, None, [], Code.NO_ECHO),
        # Without a receiver silence would be a failsafe in the climb; on the ground it is none.
        (IN_GUIDED, CLIMB, {"armed": True, "problem": NO_ECHO}, NEUTRAL, [], Code.NO_ECHO),
        (IN_GUIDED, CLIMB, {"problem": NO_ECHO}, None, [], Code.NO_ECHO),
        (IN_GUIDED, CLIMB, {"armed": True}, NEUTRAL, ["climb 10"], Code.TAKING_OFF),
        (IN_GUIDED, CLIMB, {"armed": True, "is_landed": False}, NEUTRAL, [], Code.TAKING_OFF),
        (
            IN_GUIDED,
            CLIMB,
            {"armed": True, "height_m": None, "is_landed": False},
            NEUTRAL,
            [],
            Code.TAKEOFF_NEEDS_POSITION,
        ),
        (GROUND, CLIMB | SETPOINTS, IN_OFFBOARD, None, ["climb 10"], Code.TAKING_OFF),
        (GROUND, CLIMB | SETPOINTS, {**IN_OFFBOARD, "problem": NO_ECHO}, None, [], Code.NO_ECHO),
        (
            AIRBORNE,
            SETPOINTS | {"modes": ("GUIDED",)},
            {},
            None,
            ["mode GUIDED"],
            Code.WAITING_FOR_MODE,
        ),
        (PX4_GROUND, SETPOINTS, {}, IDLE, ["mode OFFBOARD"], Code.WAITING_FOR_MODE),
        (LOITERING, SETPOINTS, {}, NEUTRAL, [], Code.WAITING_FOR_MODE),
        (LOITERING, SETPOINTS, {"mode": "OFFBOARD"}, NEUTRAL, [], None),  # it is kept by them
        (altered(LOITERING, has_receiver=False), {"modes": ("AUTO.LOITER",)}, {}, None, [], None),
        (
            LOITERING,
            SETPOINTS | {"modes": ("POSCTL",)},
            {},
            None,
            ["mode POSCTL"],
            Code.WAITING_FOR_MODE,
        ),
    ],
)
def test_one_step(
    begin: EngagementInputs,
    given: dict[str, Any],
    changes: dict[str, Any],
    control: ControlSource | None,
    asked: list[str],
    waits_for: Code | None,
) -> None:
    sequence, now = begun(begin, **given), altered(begin, **changes)
    actions = sequence.step(now, now.link.problem)
    assert (actions.control, requests([actions])) == (control, asked)
    assert (sequence.waits_for and sequence.waits_for.code) is waits_for


def test_which_mode_is_wanted() -> None:
    first = begun(GROUND)
    assert first.wanted_mode(GROUND) == "ALT_HOLD"
    assert first.wanted_mode(altered(GROUND, mode="LOITER")) is None
    nameless = altered(GROUND, modes=replace(COPTER_MODES, names=()))
    assert first.wanted_mode(nameless) == "ALT_HOLD"
    assert first.impossibility(nameless) is None
    assert begun(GROUND, mode="LOITER").wanted_mode(GROUND) == "LOITER"
    names = ", ".join(COPTER_MODES.names)
    no_such_mode = because(Code.NO_SUCH_MODE, mode="ALTCTL", modes=names)
    assert begun(GROUND, mode="ALTCTL").impossibility(GROUND) == no_such_mode
    with_loiter_alone = altered(GROUND, modes=replace(COPTER_MODES, names=("LOITER",)))
    assert first.wanted_mode(with_loiter_alone) == "LOITER"
    climbing = altered(GROUND, armed=True, mode="AUTO.TAKEOFF", modes=PX4_MODES)
    assert begun(PX4_GROUND, takeoff_m=10.0).wanted_mode(climbing) is None


def test_the_modes_of_a_takeoff_are_our_own_only_if_we_take_off() -> None:
    in_guided = altered(AIRBORNE, mode="GUIDED")
    assert begun(GROUND, takeoff_m=8.0).is_own_mode(in_guided)
    assert not begun(GROUND).is_own_mode(in_guided)
    assert not begun(AIRBORNE, takeoff_m=8.0).is_own_mode(in_guided)
    assert begun(AIRBORNE, takeoff_m=8.0).is_up
    assert not begun(GROUND, takeoff_m=8.0).is_own_mode(AIRBORNE)


def test_an_act_changes_the_mode_only_where_our_setpoints_are_needed_to_enter_it() -> None:
    loitering = altered(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES)
    setpoints = begun(loitering, modes=("OFFBOARD",), is_setpoint=True)
    assert setpoints.may_change_mode(loitering)
    assert not setpoints.may_change_mode(altered(loitering, mode="OFFBOARD"))
    assert not begun(loitering, modes=("ALTCTL",)).may_change_mode(loitering)
    assert not begun(AIRBORNE, modes=("GUIDED",), is_setpoint=True).may_change_mode(AIRBORNE)


def test_the_setpoints_of_a_second_way_in_flow_as_long_as_those_of_the_first() -> None:
    facts = altered(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES)
    sequence = begun(facts, modes=("OFFBOARD",), is_setpoint=True)
    sequence.step(facts, None)
    asked = sequence.step(altered(facts, now_ns=FLOW_NS), None)
    assert (asked.control, asked.mode) == (NEUTRAL, "OFFBOARD")
    sequence.begin(facts)
    assert not sequence.is_own_mode(altered(facts, mode="OFFBOARD"))
    later = altered(facts, now_ns=FLOW_NS + 2 * NS_PER_S)
    assert sequence.step(later, None).mode is None


def test_a_vehicle_without_sticks_that_refuses_the_mode_is_lent_ours_for_this_way_in() -> None:
    facts = altered(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES, has_receiver=False)
    sequence = begun(facts, modes=("ALTCTL",))
    assert sequence.step(facts, None) == EngagementOutput(mode="ALTCTL")
    refused = altered(facts, now_ns=1, refused_mode="ALTCTL")
    assert sequence.step(refused, None) == EngagementOutput(control=NEUTRAL)
    assert sequence.has_sticks
    flowed = altered(refused, now_ns=1 + FLOW_NS)
    assert sequence.step(flowed, None) == EngagementOutput(control=NEUTRAL, mode="ALTCTL")
    unheard = because(Code.HEARTBEAT_LOST)
    for problem in (None, unheard):  # the end of sticks would be a failsafe
        later = altered(flowed, now_ns=2 + FLOW_NS, problem=problem)
        assert sequence.step(later, None) == EngagementOutput(control=NEUTRAL)
    sequence.begin(facts)
    assert not sequence.has_sticks


@pytest.mark.parametrize(
    ("facts", "given"),
    [
        (altered(LOITERING, has_receiver=False), {"modes": ("OFFBOARD",)}),
        (altered(LOITERING, has_receiver=False), SETPOINTS | {"modes": ("ALTCTL",)}),
        (LOITERING, {"modes": ("ALTCTL",)}),
        (altered(IN_STABILIZE, has_receiver=False), {}),
    ],
)
def test_no_sticks_are_lent_for_setpoints_nor_where_none_are_lacked(
    facts: EngagementInputs, given: dict[str, Any]
) -> None:
    sequence = begun(facts, **given)
    asked = sequence.step(facts, None).mode
    sequence.step(altered(facts, now_ns=1, refused_mode=asked), None)
    assert asked is not None
    assert not sequence.has_sticks


# --- the autopilot's takeoff


def test_nine_tenths_of_the_height_are_enough_and_count_from_where_it_stood() -> None:
    sequence = begun(altered(GROUND, mode="GUIDED"), takeoff_m=10.0)
    for height_m in (0.0, -3.0):  # it drifts as long as it stands
        sequence.step(altered(GROUND, mode="GUIDED", height_m=height_m), None)
    climbing = altered(GROUND, mode="GUIDED", armed=True, is_landed=False, height_m=5.5)
    sequence.step(climbing, None)
    assert not sequence.is_up
    for height_m in (6.0, 5.0):
        sequence.step(altered(climbing, height_m=height_m), None)
        assert sequence.is_up
