"""Ways into a flight: a takeoff by the autopilot, and modes that need setpoints first."""

from dataclasses import replace

import pytest

from helpers.guard_facts import AIRBORNE, COPTER_MODES, ON_GROUND, PX4_MODES, Stepped, flying
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import OnFault
from mavbridge.guard.sequences import DisengageSettings
from mavbridge.guard.values import Actions, ControlSource, Phase

GROUND = replace(ON_GROUND, mode="STABILIZE", modes=COPTER_MODES, echo_confirmed=True)
NO_ECHO = because(Code.NO_ECHO, message="RC_CHANNELS", quantity="sticks")
PX4_GROUND = replace(GROUND, mode="AUTO.LOITER", modes=PX4_MODES)


def requests(moves: list[Actions]) -> list[str]:
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
    assert {move.control for move in stepped.moves} == {ControlSource.IDLE}
    climbing = stepped.run(2.5, armed=True)
    assert requests(climbing) == ["climb 8"] * 2
    assert {move.control for move in climbing} == {ControlSource.NEUTRAL}
    assert requests(stepped.run(2.0, is_landed=False, height_m=4.0)) == []
    assert stepped.engagement.reason == because(Code.TAKING_OFF, height_m=8)
    assert requests(stepped.run(0.5, height_m=7.3)) == ["mode ALT_HOLD"]
    stepped.step(mode="ALT_HOLD")
    assert stepped.phase is Phase.FLYING


def test_the_height_counts_from_the_place_of_arming() -> None:
    stepped = Stepped(replace(GROUND, mode="GUIDED", height_m=-3.0), arm=True, takeoff_m=8.0)
    stepped.run(0.1)
    stepped.run(0.1, armed=True, is_landed=False, height_m=4.0)
    assert stepped.engagement.reason == because(Code.TAKING_OFF, height_m=8)
    stepped.run(1.1, height_m=4.3)
    assert stepped.engagement.reason == because(Code.WAITING_FOR_MODE, mode="ALT_HOLD")


def test_a_takeoff_waits_for_a_position() -> None:
    stepped = Stepped(replace(GROUND, height_m=None), arm=True, takeoff_m=8.0)
    stepped.run(0.1)
    assert Code.TAKEOFF_NEEDS_POSITION in stepped.codes


def test_setpoints_would_end_a_takeoff_so_none_is_sent() -> None:
    stepped = Stepped(
        replace(GROUND, mode="GUIDED"), arm=True, takeoff_m=8.0, is_setpoint=True, modes=("GUIDED",)
    )
    moves = [*stepped.run(0.1), *stepped.run(1.1, armed=True), *stepped.run(1.0, height_m=5.0)]
    assert {move.control for move in moves} == {None}
    stepped.step(height_m=7.9)
    assert stepped.phase is Phase.FLYING


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
    assert {move.control for move in entering} == {ControlSource.NEUTRAL}
    stepped.step(mode="OFFBOARD")
    assert stepped.phase is Phase.FLYING


def test_another_mode_during_the_takeoff_is_the_pilots() -> None:
    stepped = Stepped(replace(GROUND, mode="GUIDED"), arm=True, takeoff_m=8.0)
    stepped.run(0.1)
    stepped.run(1.0, armed=True, is_landed=False, height_m=2.0)
    move = stepped.step(mode="LOITER")
    assert (stepped.phase, move.control, move.mode) == (
        Phase.RELEASING,
        ControlSource.RELEASE,
        None,
    )


def test_on_the_ground_idle_setpoints_flow_before_offboard_and_arming() -> None:
    stepped = Stepped(PX4_GROUND, arm=True, is_setpoint=True, modes=("OFFBOARD",))
    moves = [*stepped.run(0.1), *stepped.run(1.0, mode="OFFBOARD")]
    assert {move.control for move in moves} == {ControlSource.IDLE}
    assert requests(moves) == ["mode OFFBOARD", "arm"]


def test_in_the_air_an_act_asks_for_the_mode_that_only_our_setpoints_can_enter() -> None:
    facts = replace(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES)
    stepped = Stepped(facts, is_setpoint=True, modes=("OFFBOARD",))
    stepped.step()
    flow = [stepped.step("engage"), *stepped.run(0.09)]
    assert {(move.control, move.mode) for move in flow} == {(ControlSource.NEUTRAL, None)}
    move = stepped.step()
    assert (move.control, move.mode) == (ControlSource.NEUTRAL, "OFFBOARD")
    stepped.step(mode="OFFBOARD")
    assert stepped.phase is Phase.FLYING


def test_in_the_air_nothing_flows_where_the_mode_needs_nothing() -> None:
    facts = replace(AIRBORNE, mode="LOITER")
    stepped = Stepped(facts, is_setpoint=True, modes=("GUIDED",), mode="GUIDED")
    stepped.step()
    move = stepped.step("engage")
    assert (move.control, move.mode) == (None, "GUIDED")


def test_a_policy_of_setpoints_is_not_engaged_in_a_mode_of_sticks() -> None:
    stepped = Stepped(AIRBORNE, is_setpoint=True, modes=("GUIDED",))
    stepped.step()
    stepped.step("engage")
    wrong = because(Code.WRONG_MODE, mode="ALT_HOLD", allowed="GUIDED")
    assert stepped.engagement.refusal == because(Code.NOT_ENGAGED_SINCE, why=wrong)
    assert flying().phase is Phase.FLYING


@pytest.mark.parametrize("choice", ["auto", "release"])
def test_a_takeoff_that_is_broken_off_does_not_climb_on(choice: OnFault) -> None:
    """The receiver's sticks, which a release would give it, do nothing in GUIDED."""
    stepped = Stepped(
        replace(GROUND, mode="GUIDED"),
        arm=True,
        takeoff_m=8.0,
        disengage=DisengageSettings(then=choice),
    )
    stepped.run(0.1)
    stepped.run(1.0, armed=True, is_landed=False, height_m=2.0)
    assert stepped.step("release") == Actions(control=ControlSource.NEUTRAL, mode="BRAKE")


def entering_offboard() -> Stepped:
    """By an act in the air; the mode has come, and the policy is late."""
    facts = replace(AIRBORNE, mode="AUTO.LOITER", modes=PX4_MODES)
    stepped = Stepped(
        facts,
        is_setpoint=True,
        modes=("OFFBOARD",),
        disengage=DisengageSettings(is_setpoint=True),
    )
    stepped.step()
    stepped.step("engage")
    stepped.run(0.12)
    assert "OFFBOARD" in [move.mode for move in stepped.moves]
    stepped.step(
        mode="OFFBOARD",
        chunk_problem=because(Code.TOO_OLD, quantity="chunk", age_ms=300.0, limit_ms=100.0),
    )
    assert stepped.phase is Phase.PREPARING
    return stepped


def test_offboard_once_entered_is_kept_by_neutral_until_the_policy_is_ready() -> None:
    stepped = entering_offboard()
    assert {move.control for move in stepped.run(2.0)} == {ControlSource.NEUTRAL}
    stepped.step(chunk_problem=None)
    assert stepped.phase is Phase.FLYING


@pytest.mark.parametrize("is_late", [True, False])
def test_a_mode_of_setpoints_that_we_have_entered_is_left_again(is_late: bool) -> None:
    stepped = entering_offboard()
    if is_late:
        stepped.run(3.0)
        assert Code.NOT_ENGAGED_SINCE in stepped.codes
    else:
        stepped.step("release")
    assert stepped.phase is Phase.LEAVING
    assert "AUTO.LOITER" in [move.mode for move in stepped.moves]
    stepped.run(0.1, mode="AUTO.LOITER")
    assert stepped.phase is Phase.RELEASING


def test_a_mode_of_setpoints_that_the_pilot_chose_is_not_left() -> None:
    facts = replace(AIRBORNE, mode="GUIDED", chunk_problem=None)
    modes = ("GUIDED_NOGPS",)
    stepped = Stepped(facts, is_setpoint=True, modes=modes, mode="GUIDED_NOGPS")
    stepped.facts = replace(
        facts, modes=replace(COPTER_MODES, names=(*COPTER_MODES.names, "GUIDED_NOGPS"))
    )
    stepped.step()
    stepped.step("engage")
    move = stepped.step("release")
    assert (stepped.phase, move.mode) == (Phase.RELEASING, None)


def test_a_high_takeoff_has_the_time_that_its_climb_takes() -> None:
    stepped = Stepped(replace(GROUND, mode="GUIDED"), arm=True, takeoff_m=100.0)
    stepped.run(60.0)
    stepped.run(67.0, armed=True, is_landed=False, height_m=80.0)
    assert stepped.phase is Phase.PREPARING
    stepped.run(64.0)
    assert stepped.phase is Phase.LEAVING


def test_neutral_goes_on_in_a_climb_whose_echo_is_lost() -> None:
    """Without a receiver silence would be its radio failsafe; on the ground nothing is sent."""
    stepped = Stepped(replace(GROUND, mode="GUIDED", has_receiver=False), arm=True, takeoff_m=8.0)
    stepped.run(0.1)
    assert {move.control for move in stepped.run(0.1, link_problem=NO_ECHO)} == {None}
    stepped.run(1.0, armed=True, is_landed=False, height_m=2.0, link_problem=None)
    moves = stepped.run(1.0, link_problem=NO_ECHO)
    assert {move.control for move in moves} == {ControlSource.NEUTRAL}
