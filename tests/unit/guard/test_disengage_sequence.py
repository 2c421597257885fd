"""The way out after a fault and at a normal end, with and without a receiver, on both firmwares."""

from dataclasses import replace
from typing import Any

import pytest

from helpers.guard_facts import (
    AIRBORNE,
    COPTER_MODES,
    DEATH,
    FAULT,
    IDLE_RECEIVER,
    NO_RECEIVER,
    PX4_MODES,
    Stepped,
    altered,
    engagement_settings,
    flying,
)
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import NEUTRAL as CENTRED
from mavbridge.core.vehicle import FlightEnd, ModeRoles
from mavbridge.guard.sequences import DisengageSequence
from mavbridge.guard.values import ControlSource, EndRequest, EngagementOutput, Phase

IDLE, POLICY, NEUTRAL, LEVEL, RELEASE = ControlSource
MIDDLE = altered(AIRBORNE, pilot_sticks=CENTRED)
PX4 = altered(NO_RECEIVER, mode="ALTCTL", modes=PX4_MODES)
LOST = because(Code.VEHICLE_LOST, after_s=30)
OVERRULED = because(Code.OVERRULED, quantity="setpoints", cause="another station")


def throttle_at(position: float) -> Any:
    return altered(AIRBORNE, pilot_sticks=CENTRED._replace(throttle=position))


def at_fault(facts: Any, **rules: Any) -> Stepped:
    """A flight that has just met one."""
    stepped = flying(facts, **rules)
    stepped.step(**FAULT)
    return stepped


@pytest.mark.parametrize(
    ("facts", "rules", "mode"),
    [
        # after a fault
        (MIDDLE, {"on_fault": "auto"}, None),
        (throttle_at(-0.2), {"on_fault": "auto"}, None),
        (throttle_at(0.21), {"on_fault": "auto"}, "BRAKE"),
        (IDLE_RECEIVER, {"on_fault": "auto"}, "BRAKE"),
        (NO_RECEIVER, {"on_fault": "auto"}, "BRAKE"),
        (altered(MIDDLE, has_receiver=False), {"on_fault": "auto"}, "BRAKE"),
        (altered(MIDDLE, has_receiver=None), {"on_fault": "auto"}, "BRAKE"),
        (altered(MIDDLE, is_position_valid=False), {"on_fault": "auto"}, None),
        (altered(MIDDLE, is_position_valid=False), {"on_fault": "rtl"}, "RTL"),
        (altered(NO_RECEIVER, is_position_valid=False), {"on_fault": "auto"}, "LAND"),
        (MIDDLE, {"on_fault": "hold"}, "BRAKE"),
        (MIDDLE, {"on_fault": "land"}, "LAND"),
        (MIDDLE, {"on_fault": "rtl"}, "RTL"),
        (MIDDLE, {"on_fault": "release"}, None),
        (NO_RECEIVER, {"on_fault": "release"}, "BRAKE"),
        (IDLE_RECEIVER, {"on_fault": "release"}, "BRAKE"),
        (altered(MIDDLE, is_receiver_sick=True), {"on_fault": "release"}, "BRAKE"),
        (altered(MIDDLE, rc_channels_us=()), {"on_fault": "release"}, "BRAKE"),
        (altered(MIDDLE, rc_channels_us=(0,) * 8), {"on_fault": "auto"}, "BRAKE"),
        (altered(MIDDLE, rc_channels_us=(0, 1500)), {"on_fault": "auto"}, None),
        # at 30 ms
        (altered(MIDDLE, rc_channels_us=(), heard_ns=-220_000_000), {"on_fault": "auto"}, "BRAKE"),
        (altered(MIDDLE, rc_channels_us=(), heard_ns=-220_000_001), {"on_fault": "auto"}, None),
        (altered(AIRBORNE, pilot_sticks=None), {"on_fault": "auto"}, "BRAKE"),
        (altered(IDLE_RECEIVER, is_landed=True), {"on_fault": "auto"}, None),
        (altered(IDLE_RECEIVER, is_landed=None), {"on_fault": "auto"}, "BRAKE"),
        (altered(NO_RECEIVER, is_landed=True), {"on_fault": "auto"}, "BRAKE"),
        (altered(NO_RECEIVER, is_landed=True), {"on_fault": "release"}, "BRAKE"),
        (altered(IDLE_RECEIVER, is_landed=True), {"on_fault": "release"}, None),
        (altered(AIRBORNE, mode="LOITER"), {"is_setpoint": True, "modes": ("LOITER",)}, "BRAKE"),
        # at a normal end
        (MIDDLE, {"then": "auto"}, None),
        (IDLE_RECEIVER, {"then": "auto"}, "LAND"),
        (IDLE_RECEIVER, {"then": "release"}, "LAND"),
        (altered(IDLE_RECEIVER, is_landed=True), {"then": "auto"}, None),
        # on the ground, with a throttle that would lift it
        (altered(throttle_at(0.2), is_landed=True), {"then": "auto"}, None),
        (altered(throttle_at(0.21), is_landed=True), {"then": "auto"}, "LAND"),
        (altered(throttle_at(0.21), is_landed=True), {"on_fault": "release"}, "BRAKE"),
        (altered(AIRBORNE, pilot_sticks=None, is_landed=True), {"then": "auto"}, None),
        (NO_RECEIVER, {"then": "auto"}, "LAND"),
        (NO_RECEIVER, {"then": "release"}, "LAND"),
        (altered(NO_RECEIVER, is_landed=True), {"then": "release"}, "LAND"),
        (MIDDLE, {"then": "rtl"}, "RTL"),
        # where sticks do nothing, as in the autopilot's takeoff
        (altered(AIRBORNE, mode="GUIDED"), {"then": "auto", "modes": ("GUIDED",)}, "BRAKE"),
        (altered(AIRBORNE, mode="GUIDED"), {"then": "release", "modes": ("GUIDED",)}, "BRAKE"),
        # of a policy that has stopped the vehicle, which is held before a hand gets it
        (MIDDLE, {"then": "auto", "keeps_place": True}, "BRAKE"),
        (MIDDLE, {"then": "release", "keeps_place": True}, None),
        (MIDDLE, {"then": "land", "keeps_place": True}, "LAND"),
        (NO_RECEIVER, {"then": "auto", "keeps_place": True}, "LAND"),
        (MIDDLE, {"on_fault": "auto", "keeps_place": True}, None),
    ],
)
def test_the_mode_of_the_way_out(facts: Any, rules: Any, mode: str | None) -> None:
    stepped = flying(facts, **rules)
    move = stepped.step("release") if "then" in rules else stepped.step(**FAULT)
    assert move == EngagementOutput(control=NEUTRAL, mode=mode)
    assert mode is not None or stepped.engagement.refusal is None


@pytest.mark.parametrize("facts", [PX4, altered(PX4, has_receiver=True, pilot_sticks=CENTRED)])
@pytest.mark.parametrize(
    ("choice", "mode"), [("auto", "AUTO.LOITER"), ("land", "AUTO.LAND"), ("rtl", "AUTO.RTL")]
)
def test_where_moving_sticks_would_leave_the_mode_it_is_asked_for_once_they_rest(
    facts: Any, choice: Any, mode: str
) -> None:
    stepped = flying(facts, on_fault=choice)
    stepped.run(0.5)
    moves = [stepped.step(**FAULT)]  # at rest, but neutral has not left yet
    moves += [stepped.step(**FAULT, are_sticks_at_rest=False) for _ in range(40)]
    assert {(move.control, move.mode) for move in moves} == {(NEUTRAL, None)}
    assert stepped.step(are_sticks_at_rest=True) == EngagementOutput(control=NEUTRAL, mode=mode)


def held_by_px4(seconds: float = 0.01) -> Stepped:
    """In AUTO.LOITER for so long since a fault."""
    stepped = at_fault(PX4)
    while stepped.step().mode is None:
        pass
    stepped.run(seconds, mode="AUTO.LOITER")
    return stepped


def left_for_a_hand(
    stepped: Stepped, told_ns: int | None, **changes: Any
) -> list[EngagementOutput]:
    """AUTO.LOITER becomes POSCTL, and perhaps an EVENT tells of sticks; 0.2 s from there on."""
    changes |= {"mode": "POSCTL", "stick_override_ns": told_ns}
    return [stepped.step(**changes) for _ in range(20)]


@pytest.mark.parametrize("seconds", [0.01, 1.0])
def test_a_mode_that_is_left_for_a_hand_of_nobody_is_asked_for_again(seconds: float) -> None:
    stepped = held_by_px4(seconds)
    moves = left_for_a_hand(stepped, stepped.facts.now_ns)
    assert "AUTO.LOITER" in {move.mode for move in moves}
    assert {move.control for move in moves} == {NEUTRAL}
    stepped.step(mode="AUTO.LOITER")
    moves = left_for_a_hand(stepped, stepped.facts.status.stick_override_ns)
    assert moves[11].control is RELEASE, "the next hand needs its own EVENT"


def test_no_event_is_needed_for_a_jump_from_sticks_that_were_missed() -> None:
    stepped = held_by_px4(5.0)
    stepped.run(0.1, problem=LOST)
    moves = left_for_a_hand(stepped, None, problem=None)
    assert "AUTO.LOITER" in {move.mode for move in moves}
    assert {move.control for move in moves} == {NEUTRAL}
    stepped.run(1.1, mode="AUTO.LOITER")
    assert left_for_a_hand(stepped, None)[0].control is RELEASE


@pytest.mark.parametrize(
    ("told_ns", "seconds", "changes", "waits"),
    [
        (None, 0.01, {}, 11),  # its word is waited for 100 ms
        (0, 0.01, {}, 11),
        (NS_PER_S, 1.01, {}, 0),
        (NS_PER_S, 0.01, {"echo_confirmed": False}, 0),
        (NS_PER_S, 0.01, {"overruled": OVERRULED}, 0),
    ],
)
def test_another_stations_mode_and_a_hand_of_the_pilots_win(
    told_ns: int | None, seconds: float, changes: Any, waits: int
) -> None:
    moves = left_for_a_hand(held_by_px4(seconds), told_ns, **changes)
    assert {move.mode for move in moves} == {None}
    assert [move.control for move in moves].index(RELEASE) == waits


SINCE, WORD = {"undone_ns": NS_PER_S}, 100 * NS_PER_MS
MISSED = {"missed_ns": 1_500_000_000}


@pytest.mark.parametrize(
    ("fields", "changes", "is_undone", "undone_ns"),
    [
        ({}, {}, True, NS_PER_S + 1),
        ({"mode": None}, {}, False, None),
        ({"asked_ns": None}, {}, False, None),
        ({}, {"mode": "ALTCTL"}, False, None),
        ({}, {"echo_confirmed": False}, False, None),
        ({}, {"overruled": OVERRULED}, False, None),
        ({}, {"now_ns": 2 * NS_PER_S}, True, 2 * NS_PER_S),
        ({}, {"now_ns": 2 * NS_PER_S + 1}, False, 2 * NS_PER_S + 1),
        (SINCE, {"now_ns": NS_PER_S + WORD}, True, NS_PER_S),
        (SINCE, {"now_ns": NS_PER_S + WORD + 1}, False, NS_PER_S),
        (SINCE, {"now_ns": NS_PER_S + WORD + 1, "stick_override_ns": NS_PER_S}, True, NS_PER_S),
        (SINCE, {"now_ns": NS_PER_S + WORD + 1, "stick_override_ns": 1}, False, NS_PER_S),
        (SINCE, {"mode": "AUTO.LOITER"}, False, None),
        # its sticks were not ours before: they jumped to a receiver's and back, and no EVENT came
        (MISSED, {"now_ns": 2_500_000_000}, True, 2_500_000_000),
        (MISSED, {"now_ns": 2_500_000_001}, False, 2_500_000_001),
        (MISSED | {"undone_ns": 2_500_000_000}, {"now_ns": 9 * NS_PER_S}, True, 2_500_000_000),
        (MISSED, {"now_ns": 2_500_000_000, "overruled": OVERRULED}, False, None),
    ],
)
def test_when_our_sticks_have_ended_the_safe_mode(
    fields: Any, changes: Any, is_undone: bool, undone_ns: int | None
) -> None:
    asked = {"mode": "AUTO.LOITER", "asked_ns": NS_PER_S, "entered_ns": NS_PER_S}
    asked["request_due_ns"] = 3 * NS_PER_S
    sequence = DisengageSequence(engagement_settings(), **asked | fields)
    now = altered(PX4, **{"mode": "POSCTL", "now_ns": NS_PER_S + 1, **changes})
    assert sequence.is_undone(now) is is_undone
    sequence.step(now, None)
    assert (sequence.undone_ns, sequence.is_done) == (undone_ns, not is_undone)
    is_entered = sequence.asked_ns is not None and sequence.mode in (None, now.status.mode)
    assert (sequence.entered_ns == now.now_ns) is is_entered


def test_a_refused_mode_becomes_land() -> None:
    stepped = at_fault(IDLE_RECEIVER)
    moves = stepped.run(0.2, refused_mode="BRAKE")
    assert "LAND" in {move.mode for move in moves}
    assert stepped.step(mode="LAND", refused_mode=None).control is RELEASE
    late = at_fault(NO_RECEIVER).run(0.3, mode="BRAKE", refused_mode="BRAKE")
    assert {move.mode for move in late} == {None}, "it has come all the same"
    sequence, refused = DisengageSequence(engagement_settings()), {"refused_mode": "BRAKE"}
    for _ in range(2):
        sequence.begin(altered(IDLE_RECEIVER, **refused), is_planned=False)
        move = sequence.step(altered(IDLE_RECEIVER, **refused), None)
        assert move.mode == "BRAKE", "an earlier flight's refusal is over"


@pytest.mark.parametrize("hold", ["", "BRAKE"])
def test_where_the_vehicle_has_no_such_mode_neutral_holds_it(hold: str) -> None:
    facts = altered(IDLE_RECEIVER, modes=replace(COPTER_MODES, hold=hold, land=""))
    stepped = at_fault(facts)
    stepped.run(5, refused_mode="BRAKE")
    assert {move.control for move in stepped.moves[2:]} == {NEUTRAL}
    assert {move.mode for move in stepped.moves} == {None, hold or None}
    assert stepped.phase is Phase.HOLDING


@pytest.mark.parametrize("settings", [{}, {"on_fault": "release", "then": "release"}])
@pytest.mark.parametrize("is_fault", [True, False])
@pytest.mark.parametrize("throttle", [-1.0, -0.21, 0.21, 1.0, None])
def test_no_hand_gets_the_sticks_that_would_not_hold_the_vehicle(
    throttle: float | None, is_fault: bool, settings: Any
) -> None:
    sticks = None if throttle is None else CENTRED._replace(throttle=throttle)
    stepped = flying(altered(AIRBORNE, pilot_sticks=sticks), **settings)
    end: FlightEnd = "fault" if is_fault else "duration"
    stepped.engagement.stop(EndRequest(because(Code.DURATION), end))
    mode = stepped.step().mode
    assert mode == ("BRAKE" if is_fault else "LAND")
    why = because(Code.THROTTLE_UNKNOWN)
    if throttle is not None:
        why = because(Code.THROTTLE_RESTS, percent=100 * throttle, limit_percent=20)
    refusal = because(Code.NOT_RELEASED, instead="hold" if is_fault else "land", why=why)
    assert stepped.engagement.refusal == (refusal if settings else None)
    assert {move.control for move in stepped.run(40)} == {NEUTRAL}, "never confirmed"
    assert stepped.step(mode=mode).control is RELEASE


def test_an_unconfirmed_mode_is_given_up_after_three_seconds() -> None:
    stepped = at_fault(IDLE_RECEIVER)
    stepped.run(2.98)
    assert stepped.phase is Phase.LEAVING
    assert {move.control for move in stepped.run(0.03)} == {NEUTRAL}
    assert stepped.phase is Phase.HOLDING
    assert stepped.engagement.refusal == because(Code.MODE_NOT_CONFIRMED, mode="BRAKE")
    assert sum(move.mode == "BRAKE" for move in stepped.run(5)) == 5, "asked for again"
    stepped.run(1.0, problem=because(Code.HEARTBEAT_LOST))
    assert sum(move.mode == "BRAKE" for move in stepped.run(1)) == 10, "nobody sees a refusal"
    stepped.step(problem=None)
    assert stepped.step(mode="BRAKE").control is RELEASE
    stepped.run(1)
    assert stepped.phase is Phase.RELEASED
    assert stepped.engagement.refusal == because(Code.RELEASE_NOT_SEEN)


def test_a_vehicle_that_has_vanished_is_not_held_for_ever() -> None:
    stepped = flying(NO_RECEIVER)
    stepped.engagement.stop(DEATH)
    stepped.step()
    stepped.run(0.2, mode="BRAKE")
    assert stepped.phase is Phase.HOLDING
    for _ in range(2):
        moves = stepped.run(29, heard_ns=stepped.facts.now_ns, mode_arrived_ns=stepped.facts.now_ns)
        assert {move.control for move in moves} == {NEUTRAL}
        stepped.run(1, heard_ns=None, mode_arrived_ns=None)
    stepped.run(33, heard_ns=stepped.facts.now_ns, mode_arrived_ns=stepped.facts.now_ns)
    assert stepped.engagement.reason == because(Code.THEN, first=DEATH.reason, then=LOST)
    assert stepped.phase is Phase.ENDED


@pytest.mark.parametrize("facts", [IDLE_RECEIVER, MIDDLE])
@pytest.mark.parametrize("mode", ["STABILIZE", "ACRO"])
def test_where_the_throttle_is_thrust_the_mode_goes_before_neutral_and_no_hand_holds_it(
    facts: Any, mode: str
) -> None:
    stepped = flying(altered(facts, mode=mode), modes=(mode,), on_fault="release")
    moves = [stepped.step(**FAULT)]
    why = because(Code.THROTTLE_IS_THRUST, mode=mode)
    assert stepped.engagement.refusal == because(Code.NOT_RELEASED, instead="hold", why=why)
    moves += stepped.run(5)
    assert {move.control for move in moves} == {LEVEL}
    assert moves[0].mode == "BRAKE"
    assert stepped.step(mode="BRAKE").control in (NEUTRAL, RELEASE)


@pytest.mark.parametrize("act", ["release", None])
def test_a_start_that_failed_in_the_air_can_be_stopped_like_a_flight(act: Any) -> None:
    facts = altered(NO_RECEIVER, armed=False, is_landed=True, height_m=0.0)
    stepped = Stepped(facts, arm=True, takeoff_m=3.0)
    stepped.run(0.1, mode="GUIDED")
    stepped.run(1.0, armed=True, is_landed=False, height_m=3.0)
    stepped.run(95, mode="ALT_HOLD", chunk_problem=because(Code.NO_IMAGE))
    stepped.run(5, mode="BRAKE")
    assert stepped.phase is Phase.HOLDING
    stepped.step(act, stop=None if act else EndRequest(because(Code.SIGNAL)))
    assert "LAND" in [move.mode for move in stepped.run(1)]


def test_where_px4_may_take_a_jump_to_neutral_for_a_hand_the_throttle_stays() -> None:
    stepped = at_fault(altered(PX4, mode="STABILIZED"), modes=("STABILIZED",))
    assert {move.control for move in stepped.run(1.0, mode="AUTO.LOITER")} == {LEVEL}


@pytest.mark.parametrize(
    ("throttle", "last", "mode"), [(-0.2, [RELEASE] * 2, None), (-0.19, [LEVEL] * 2, "BRAKE")]
)
def test_where_the_throttle_is_thrust_it_stays_until_a_release_on_the_ground_to_a_low_one(
    throttle: float, last: list[ControlSource], mode: str | None
) -> None:
    facts = altered(throttle_at(throttle), mode="STABILIZE", is_landed=True)
    stepped = flying(facts, modes=("STABILIZE",))
    moves = [stepped.step(**FAULT), *stepped.run(0.06)]
    assert [move.control for move in moves] == [LEVEL] * 5 + last
    assert moves[0].mode == mode


# --- PX4, which sees neither our sticks nor the pilot's for a moment after the release

HAND = altered(AIRBORNE, mode="ALTCTL", modes=replace(PX4_MODES, is_silence_failsafe=False))
IN_HOLD = altered(HAND, mode="AUTO.LOITER")
IN_OFFBOARD = altered(HAND, mode="OFFBOARD")


def released(facts: Any = HAND, **rules: Any) -> Stepped:
    stepped = flying(facts, modes=(facts.status.mode,), **rules)
    stepped.step("release")
    stepped.run(0.05, mode=stepped.engagement.disengage.mode or "ALTCTL")
    stepped.facts = altered(stepped.facts, stick_loss_ns=stepped.facts.now_ns + 1)
    return stepped


DROPPED = {"mode": "AUTO.LOITER", "is_failsafe": True, "is_released": True}


def test_px4s_failsafe_for_want_of_sticks_is_undone_ten_times_a_second_for_1_5_s() -> None:
    stepped = released()
    assert {move.mode for move in stepped.run(0.09)} == {None}
    moves = stepped.run(2.0, **DROPPED)
    assert [k for k, move in enumerate(moves) if move.mode == "ALTCTL"] == [*range(0, 150, 10)]
    assert (stepped.phase, stepped.engagement.refusal) == (Phase.RELEASED, None)
    assert stepped.step(mode="ALTCTL") == EngagementOutput()
    assert stepped.engagement.refusal is None, "it is the mode of the release"


@pytest.mark.parametrize(
    ("start", "changes", "mode"),
    [
        (released, {}, "ALTCTL"),
        (released, {"stick_loss_ns": None}, None),
        (released, {"stick_loss_ns": 80 * NS_PER_MS}, None),  # at the release
        (released, {"is_failsafe": False}, None),
        (released, {"armed": False}, None),
        (released, {"mode": "AUTO.RTL"}, None),  # a geofence, a battery
        (released, {"is_mode_chosen": True}, None),  # by a pilot
        (released, {"modes": PX4_MODES}, None),
        (released, {"modes": replace(HAND.link.modes, override="")}, None),
        (lambda: released(IN_HOLD), {"is_mode_chosen": True}, "AUTO.LOITER"),
        (lambda: released(IN_OFFBOARD, is_setpoint=True), {}, None),
    ],
)
def test_which_failsafe_after_a_release_is_undone(start: Any, changes: Any, mode: Any) -> None:
    assert {move.mode for move in start().run(0.1, **DROPPED | changes)} == {None, mode}


@pytest.mark.parametrize("taken", [{"mode": "POSCTL"}, {"is_failsafe": True}])
def test_no_failsafe_is_undone_after_a_takeover(taken: Any) -> None:
    stepped = flying(HAND)
    stepped.step(**taken)
    assert stepped.step(**DROPPED, stick_loss_ns=stepped.facts.now_ns + 1).mode is None


# --- a vehicle that is not heard, and our own standstill


def silence(stepped: Any, seconds: float) -> list[EngagementOutput]:
    """No packet of the vehicle for a while."""
    now_ns = stepped.facts.now_ns
    moves: list[EngagementOutput] = stepped.run(seconds, heard_ns=now_ns, mode_arrived_ns=now_ns)
    return moves


def standstill(stepped: Any, seconds: float, **changes: Any) -> EngagementOutput:
    """The guard does not run for a while; the first step after it."""
    facts = stepped.facts
    now_ns = facts.now_ns + round(seconds * 1e9)
    stepped.facts = altered(facts, now_ns=now_ns)
    move: EngagementOutput = stepped.step(mode_arrived_ns=now_ns - 1_000_000, **changes)
    return move


@pytest.mark.parametrize(
    ("facts", "blind_s"),
    [
        (IDLE_RECEIVER, 3.0),
        (NO_RECEIVER, 0.5),
        (PX4, 0.5),
        (altered(IDLE_RECEIVER, modes=replace(COPTER_MODES, needs_setpoints_first=True)), 0.5),
    ],
)
def test_a_vehicle_that_is_not_heard_is_asked_only_until_its_own_failsafe(
    facts: Any, blind_s: float
) -> None:
    stepped = at_fault(facts)
    moves = silence(stepped, 5)
    assert stepped.phase is Phase.LEAVING, "it is not given up"
    assert {move.control for move in moves} == {NEUTRAL}
    asked = [k / 100 for k, move in enumerate(moves) if move.mode is not None]
    assert blind_s - 0.11 <= asked[-1] <= blind_s
    assert {move.mode for move in stepped.run(0.1, heard_ns=None)} == {None}, "not which mode"
    found = stepped.step(mode_arrived_ns=None)
    assert (found.control, found.mode) == (NEUTRAL, facts.link.modes.hold)


def test_a_mode_that_was_asked_for_before_a_silence_is_ours_after_it() -> None:
    stepped = at_fault(NO_RECEIVER)
    silence(stepped, 5)
    stepped.run(0.1, heard_ns=None, mode_arrived_ns=None, mode="BRAKE")
    stepped.step(mode="LOITER")
    changed = because(Code.MODE_CHANGED, before="BRAKE", after="LOITER")
    assert stepped.engagement.reason == because(Code.THEN, first=FAULT["chunk_fault"], then=changed)


@pytest.mark.parametrize(
    ("is_failsafe", "blind_ns"), [(True, NS_PER_S // 2), (False, 3 * NS_PER_S)]
)
def test_the_time_for_which_a_mode_is_asked_for_unheard_includes_its_end(
    is_failsafe: bool, blind_ns: int
) -> None:
    settings = engagement_settings()
    sequence = DisengageSequence(settings, mode="BRAKE", is_silence_failsafe=is_failsafe)
    assert sequence.step(altered(AIRBORNE, now_ns=blind_ns + 2), 1) == EngagementOutput(
        control=NEUTRAL
    )
    assert sequence.step(altered(AIRBORNE, now_ns=blind_ns + 1), 1).mode == "BRAKE"


@pytest.mark.parametrize(
    ("facts", "own"), [(NO_RECEIVER, "RTL"), (NO_RECEIVER, "LAND"), (PX4, "AUTO.RTL")]
)
@pytest.mark.parametrize("is_ours", [True, False])
def test_a_failsafe_of_its_own_is_its_way_out_after_a_silence(
    facts: Any, own: str, is_ours: bool
) -> None:
    stepped = at_fault(facts)
    if is_ours:
        silence(stepped, 4)
    else:
        standstill(stepped, 4)
    news = {"heard_ns": None, "mode_arrived_ns": None, "mode": own, "is_failsafe": True}
    assert stepped.step(**news) == EngagementOutput(control=RELEASE)
    assert {move.mode for move in stepped.run(5)} == {None}


@pytest.mark.parametrize("facts", [NO_RECEIVER, PX4])
def test_after_a_standstill_of_ours_what_had_arrived_tells_no_mode(facts: Any) -> None:
    stepped = flying(facts)
    first = standstill(stepped, 4, **FAULT)
    assert (first.control, first.mode) == (NEUTRAL, None), "the mode is of before"
    assert {move.mode for move in stepped.run(1)} == {None}
    assert stepped.step(mode_arrived_ns=None).mode == facts.link.modes.hold


def test_a_standstill_is_longer_than_250_ms_and_a_silence_behind_it_lengthens_it() -> None:
    short = flying(NO_RECEIVER)
    assert standstill(short, 0.24, **FAULT).mode == "BRAKE"
    assert "BRAKE" in {move.mode for move in short.run(1.0)[60:]}
    stepped = flying(NO_RECEIVER)
    assert standstill(stepped, 4, **FAULT).mode is None
    moves = stepped.run(1.0, heard_ns=stepped.facts.now_ns)
    assert {move.mode for move in moves} == {None}


@pytest.mark.parametrize(("silent_s", "is_asked"), [(0.25, True), (0.26, False)])
def test_after_a_silence_of_more_than_250_ms_the_mode_is_not_known(
    silent_s: float, is_asked: bool
) -> None:
    stepped = flying(NO_RECEIVER)
    silence(stepped, silent_s)
    moves = stepped.run(0.7, heard_ns=None, **FAULT)
    assert ("BRAKE" in {move.mode for move in moves[-10:]}) is is_asked


def test_old_data_comes_out_of_pipes_for_50_ms_after_a_standstill() -> None:
    stepped = flying(NO_RECEIVER)
    standstill(stepped, 4, **FAULT)
    until_ns = stepped.facts.now_ns + 50 * NS_PER_MS
    stepped.run(0.1)
    assert stepped.step(mode_arrived_ns=until_ns).mode is None
    assert stepped.step(mode_arrived_ns=until_ns + 1).mode == "BRAKE"


def test_a_command_that_failed_delays_only_its_own_way_out() -> None:
    sequence, asked = DisengageSequence(engagement_settings()), []
    for fault in (because(Code.COMMAND_FAILED), None):
        sequence.begin(PX4, is_planned=False)
        facts = altered(PX4, now_ns=PX4.now_ns + NS_PER_MS, command_fault=fault)
        asked.append(sequence.step(facts, None).mode)
    assert asked == [None, "AUTO.LOITER"]


def test_a_vehicle_that_is_heard_again_has_its_time_to_answer() -> None:
    stepped = at_fault(IDLE_RECEIVER)
    silence(stepped, 10)
    moves = stepped.run(2.9, heard_ns=None, mode_arrived_ns=None)
    assert moves[0].mode == "BRAKE"
    assert sum(move.mode == "BRAKE" for move in moves) == 29
    assert stepped.phase is Phase.LEAVING


@pytest.mark.parametrize("has_receiver", [True, False])
@pytest.mark.parametrize(
    ("mode", "modes", "hold", "land"),
    [
        ("GUIDED", COPTER_MODES, "BRAKE", "LAND"),
        ("OFFBOARD", PX4_MODES, "AUTO.LOITER", "AUTO.LAND"),
    ],
)
def test_setpoints_end_in_a_mode_that_holds_and_then_in_silence(
    has_receiver: bool, mode: str, modes: ModeRoles, hold: str, land: str
) -> None:
    facts = altered(AIRBORNE, mode=mode, modes=modes, has_receiver=has_receiver)
    rules: dict[str, Any] = {"modes": (mode,), "is_setpoint": True}
    stepped = flying(facts, **rules)
    fault = stepped.step(**FAULT)
    assert (fault.control, fault.mode) == (NEUTRAL, hold)
    after = stepped.run(0.2, mode=hold)
    assert after[-1].control is RELEASE
    assert stepped.phase is Phase.RELEASING
    ended = flying(facts, **rules)
    ended.engagement.stop(EndRequest(reason=because(Code.DURATION)))
    assert ended.step().mode == (hold if has_receiver else land)
    assert ended.engagement.outcome.end == "signal"


def test_a_vehicle_that_does_not_answer_gets_no_more_setpoints_which_might_take_it_back() -> None:
    facts = altered(AIRBORNE, mode="OFFBOARD", modes=PX4_MODES)
    stepped = flying(facts, modes=("OFFBOARD",), is_setpoint=True)
    moves = [stepped.step(**FAULT), *stepped.run(0.5)]
    assert {move.control for move in moves} == {NEUTRAL}
    unheard = stepped.run(2.4)
    assert {move.control for move in unheard} == {None}
    assert sum(move.mode == "AUTO.LOITER" for move in unheard) == 24
    failed = stepped.step(mode="AUTO.RTL", is_failsafe=True)
    assert failed == EngagementOutput(control=RELEASE)


GUIDED = altered(AIRBORNE, mode="GUIDED")


@pytest.mark.parametrize(("is_landed", "hand"), [(True, IDLE), (False, NEUTRAL)])
def test_on_the_ground_setpoints_end_idle_since_the_thrust_that_hovers_lifts(
    is_landed: bool, hand: ControlSource
) -> None:
    facts = altered(GUIDED, is_landed=is_landed)
    stepped = flying(facts, is_setpoint=True, modes=("GUIDED",))
    assert stepped.step("release").control is hand


@pytest.mark.parametrize(
    ("facts", "last"),
    [(GUIDED, NEUTRAL), (altered(GUIDED, mode="OFFBOARD", modes=PX4_MODES), None)],
)
def test_neutral_goes_on_unanswered_where_it_cannot_bring_the_mode_back(
    facts: Any, last: ControlSource | None
) -> None:
    stepped = at_fault(facts, is_setpoint=True, modes=(facts.status.mode,))
    assert stepped.run(2.0)[-1].control is last
