from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from mavbridge.core.clock import NS_PER_S
from mavbridge.core.errors import PeerError
from mavbridge.core.vehicle import Release
from mavbridge.gate.engagement import (
    PREPARE_TIMEOUT_NS,
    RETAKE_NS,
    Directive,
    Engagement,
    Facts,
    Hold,
    Phase,
    check_chunk,
)

S = NS_PER_S
READY = Facts(
    now_ns=0,
    link_problem=None,
    input_problem=None,
    mode="ALT_HOLD",
    armed=True,
    is_overruled=False,
    echo_confirmed=True,
)
GROUND = replace(READY, armed=False)


def released(directive: Directive) -> str:
    assert isinstance(directive.sticks, Release), directive
    return directive.sticks.reason


def flying(**options: object) -> Engagement:
    settings: dict[str, object] = {"wanted_mode": None, "arm": False, "readonly": False} | options
    engagement = Engagement(**settings)  # type: ignore[arg-type]
    assert engagement.step(READY).sticks is Hold.FLY
    return engagement


def test_it_waits_for_the_pilot_to_arm_unless_asked() -> None:
    engagement = Engagement(wanted_mode=None, arm=False, readonly=False)
    directive = engagement.step(GROUND)
    assert "disarmed" in released(directive)
    assert directive.request is None
    assert engagement.step(READY).sticks is Hold.FLY


def test_asked_to_arm_it_idles_changes_mode_arms_and_flies() -> None:
    engagement = Engagement(wanted_mode="alt_hold", arm=True, readonly=False)
    start = replace(GROUND, mode="STABILIZE", echo_confirmed=False, input_problem="no feature")
    assert engagement.step(start) == Directive(sticks=Hold.IDLE)
    no_echo = replace(start, input_problem=None)
    assert engagement.step(no_echo) == Directive(sticks=Hold.IDLE)
    echoed = replace(no_echo, echo_confirmed=True)
    assert engagement.step(echoed) == Directive(sticks=Hold.IDLE, request="mode")
    in_mode = replace(echoed, mode="ALT_HOLD")
    assert engagement.step(in_mode) == Directive(sticks=Hold.IDLE, request="arm")
    assert engagement.step(replace(in_mode, armed=True)).sticks is Hold.FLY


def test_it_arms_once_and_never_again_by_itself() -> None:
    engagement = flying(arm=True)
    for _ in range(3):
        directive = engagement.step(GROUND)
        assert "disarmed" in released(directive)
        assert directive.request is None


def test_arming_in_a_mode_without_sticks_needs_a_mode_flag() -> None:
    engagement = Engagement(wanted_mode=None, arm=True, readonly=False)
    assert "--mode" in released(engagement.step(replace(GROUND, mode="AUTO")))


def test_a_mode_is_asked_for_without_arming_when_only_that_was_wanted() -> None:
    engagement = Engagement(wanted_mode="ACRO", arm=False, readonly=False)
    directive = engagement.step(GROUND)
    assert released(directive)
    assert directive.request == "mode"
    assert engagement.step(replace(READY)).request == "mode"


def test_the_pilot_takes_over_by_changing_the_mode_until_disarmed() -> None:
    engagement = flying()
    assert "ALT_HOLD to LOITER" in released(engagement.step(replace(READY, mode="LOITER")))
    assert engagement.phase is Phase.LATCHED
    # Changing back does not hand the sticks back; a link problem does not clear it either.
    assert "somebody else" in released(engagement.step(READY))
    released(engagement.step(replace(READY, link_problem="lost")))
    assert "somebody else" in released(engagement.step(READY))
    released(engagement.step(GROUND))
    assert engagement.step(READY).sticks is Hold.FLY


def test_a_mode_change_behind_a_link_problem_is_a_takeover_too() -> None:
    engagement = flying()
    released(engagement.step(replace(READY, link_problem="heartbeat lost")))
    assert "ALT_HOLD to RTL" in released(engagement.step(replace(READY, mode="RTL")))


def test_a_link_problem_releases_for_as_long_as_it_lasts() -> None:
    engagement = flying()
    assert released(engagement.step(replace(READY, link_problem="lost"))) == "lost"
    assert engagement.step(READY).sticks is Hold.FLY


def test_inputs_must_stay_good_before_the_sticks_are_taken_back() -> None:
    engagement = flying()
    bad = replace(READY, input_problem="too old")
    assert released(engagement.step(replace(bad, now_ns=S))) == "too old"
    assert "waiting to see" in released(engagement.step(replace(READY, now_ns=S + RETAKE_NS // 2)))
    assert released(engagement.step(replace(bad, now_ns=S + RETAKE_NS // 2))) == "too old"
    assert "waiting to see" in released(engagement.step(replace(READY, now_ns=S + RETAKE_NS)))
    assert engagement.step(replace(READY, now_ns=S + 2 * RETAKE_NS)).sticks is Hold.FLY


def test_sticks_that_the_vehicle_no_longer_takes_are_left_until_disarmed() -> None:
    engagement = flying()
    overruled = replace(READY, link_problem="does not act on our sticks", is_overruled=True)
    assert "does not act" in released(engagement.step(overruled))
    assert "somebody else" in released(engagement.step(READY))
    released(engagement.step(GROUND))
    assert engagement.step(READY).sticks is Hold.FLY


def test_an_override_that_fails_on_the_ground_is_tried_again() -> None:
    engagement = Engagement(wanted_mode="ALT_HOLD", arm=True, readonly=False)
    overruled = replace(GROUND, link_problem="does not act", is_overruled=True)
    released(engagement.step(overruled))
    assert engagement.step(GROUND).sticks is Hold.IDLE


def test_a_mode_that_was_reached_is_not_asked_for_again_over_the_pilot() -> None:
    engagement = Engagement(wanted_mode="ALT_HOLD", arm=True, readonly=False)
    assert engagement.step(GROUND).request == "arm"
    waiting = replace(READY, input_problem="no feature")
    released(engagement.step(waiting))
    directive = engagement.step(replace(waiting, mode="LAND"))
    assert "ALT_HOLD to LAND" in released(directive)
    assert directive.request is None
    assert engagement.step(replace(READY, mode="LAND")).request is None


def test_an_arming_that_never_flew_is_the_only_one() -> None:
    engagement = Engagement(wanted_mode=None, arm=True, readonly=False)
    assert engagement.step(GROUND).request == "arm"
    released(engagement.step(replace(READY, input_problem="no feature")))
    directive = engagement.step(GROUND)
    assert directive.request is None
    assert "disarmed" in released(directive)


@pytest.mark.parametrize("armed", [False, True])
@pytest.mark.parametrize("mode", ["ALT_HOLD", "AUTO"])
def test_readonly_runs_whatever_the_vehicle_does(armed: bool, mode: str) -> None:
    engagement = Engagement(wanted_mode=None, arm=False, readonly=True)
    directive = engagement.step(replace(READY, armed=armed, mode=mode, echo_confirmed=False))
    assert directive == Directive(sticks=Hold.FLY)


def test_preparing_has_a_deadline() -> None:
    engagement = Engagement(wanted_mode="ALT_HOLD", arm=True, readonly=False)
    engagement.step(replace(GROUND, echo_confirmed=False))
    with pytest.raises(PeerError, match="not ready after 90 s"):
        engagement.step(replace(GROUND, now_ns=PREPARE_TIMEOUT_NS + 1, echo_confirmed=False))


EVENTS = [
    replace(READY, armed=armed, mode=mode, link_problem=link, input_problem=inputs)
    for armed, mode, link, inputs in product(
        [False, True], ["ALT_HOLD", "LOITER", "RTL"], [None, "link"], [None, "input"]
    )
]


@pytest.mark.parametrize("arm", [False, True])
def test_every_pair_of_events_keeps_the_rules(arm: bool) -> None:
    """From every state that two events reach, every third event: sticks only where allowed."""
    for first, second, third in product(EVENTS, repeat=3):
        third = replace(third, now_ns=10 * S)  # long after any input that failed
        engagement = Engagement(wanted_mode=None, arm=arm, readonly=False)
        for facts in (first, second):
            engagement.step(facts)
        was_latched = engagement.phase is Phase.LATCHED
        directive = engagement.step(third)
        if directive.sticks is Hold.FLY:
            assert third.armed
            assert third.link_problem is None
            assert third.input_problem is None
            assert third.mode in ("ALT_HOLD", "LOITER")
            assert not was_latched
        if directive.sticks is Hold.IDLE:
            assert arm
            assert not third.armed
        if directive.request == "arm":
            assert arm
            assert not first.armed
            assert not second.armed


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_chunk_that_is_not_finite_is_refused(bad: float) -> None:
    chunk = np.zeros((1, 16, 4), dtype=np.float32)
    assert check_chunk(chunk) is None
    chunk[0, 7, 2] = bad
    assert isinstance(check_chunk(chunk), Release)
