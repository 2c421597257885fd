"""Loss of sticks or setpoints on PX4, and the takeover after it."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.px4_companion import (
    ACCEPTED,
    ALTCTL,
    EVENT,
    LOITER,
    MID,
    OFFBOARD,
    POSCTL,
    REJECTED,
    RTL,
    attitude_target,
    custom,
    event_id,
    modes_in,
    named,
)

LEANING = (0, 700, 500, 0)
TOOK_OVER_IN_FAILSAFE = 0x010EAC3F
HOLD_TEXT = "Failsafe activated: entering Hold for"


def goes_to(px4, mode, within_s, send=lambda _: None):
    """Seconds until CURRENT_MODE shows the mode."""
    took_s, _ = px4.until(
        lambda m: any(x.custom_mode == custom(mode) for x in modes_in(m)), within_s, send
    )
    return took_s


def take_off_by_setpoints(px4):
    """Arm and climb in OFFBOARD, without sticks."""
    px4.track()
    px4.get_ready(LOITER)
    px4.advance(1.0)
    px4.stream_setpoint(attitude_target(thrust=0.0), 0.3)
    assert px4.set_mode(OFFBOARD) == ACCEPTED
    assert px4.arm() == ACCEPTED
    px4.stream_setpoint(attitude_target(thrust=0.65), 4.0)


@pytest.mark.parametrize(("gap_s", "fails"), [(0.3, False), (0.5, False), (0.8, True)])
def test_a_short_gap_is_forgiven(px4_flying, gap_s, fails):
    px4_flying.refill_delay()
    px4_flying.advance(gap_s)
    assert px4_flying.hears(HOLD_TEXT, 1.0, px4_flying.holding()) == fails


def test_lost_sticks_are_held_then_hold_then_return(px4_flying):
    px4_flying.refill_delay()
    px4_flying.fly(1.0, LEANING)
    held_s, messages = px4_flying.until(
        lambda m: any(x.custom_mode == custom(LOITER) for x in modes_in(m)), 2.0
    )
    leans = [math.degrees(m.roll) for m in named(messages, "ATTITUDE")]
    assert 0.55 <= held_s <= 0.8
    assert min(leans) > 20.0, "the last stick is held until then"
    assert modes_in(messages)[-1].intended_custom_mode == custom(ALTCTL)
    assert 4.5 <= goes_to(px4_flying, RTL, 7.0) <= 5.5
    px4_flying.advance(0.5)
    texts = px4_flying.texts()
    assert "Failsafe activated: entering Hold for 5 seconds" in texts
    assert "Failsafe activated" in texts


def test_returning_sticks_do_not_give_the_mode_back(px4_flying):
    px4_flying.refill_delay(2.0)
    goes_to(px4_flying, LOITER, 2.0)
    assert goes_to(px4_flying, RTL, 7.0, px4_flying.holding()) <= 2.6
    px4_flying.fly(1.0)
    assert px4_flying.mode() == custom(RTL)


def test_a_mode_command_ends_the_failsafe(px4_flying):
    px4_flying.refill_delay(2.0)
    goes_to(px4_flying, LOITER, 2.0)
    assert px4_flying.set_mode(ALTCTL) == REJECTED, "it needs sticks"
    assert px4_flying.set_mode(LOITER) == ACCEPTED
    px4_flying.advance(2.5)
    assert px4_flying.mode() == custom(LOITER)
    px4_flying.fly(0.3)
    assert px4_flying.set_mode(ALTCTL) == ACCEPTED
    px4_flying.fly(0.2)
    assert px4_flying.mode() == custom(ALTCTL)


def test_moving_the_sticks_takes_the_return_over_in_posctl(px4_flying):
    px4_flying.refill_delay(1.0)
    goes_to(px4_flying, RTL, 8.0)
    px4_flying.fly(0.5)

    def ramp(elapsed_s: float) -> None:
        px4_flying.sticks((0, min(1000, int(1000 * elapsed_s / 0.5)), 500, 0))

    assert goes_to(px4_flying, POSCTL, 1.0, ramp) < 0.6
    px4_flying.fly(0.3, (0, 1000, 500, 0))
    events = [event_id(m) for m in named(px4_flying.seen, f"UNKNOWN_{EVENT}")]
    assert TOOK_OVER_IN_FAILSAFE in events, "an event, but no text"


def test_the_loss_time_is_a_parameter(px4_flying):
    px4_flying.refill_delay()
    px4_flying.change("COM_RC_LOSS_T", 2.0)
    px4_flying.fly(0.2)
    assert 1.9 <= goes_to(px4_flying, LOITER, 4.0) <= 2.4


def test_sticks_that_were_never_there_are_not_missed(px4_grounded):
    take_off_by_setpoints(px4_grounded)
    assert px4_grounded.mode() == custom(OFFBOARD)
    assert not [text for text in px4_grounded.texts() if "Failsafe" in text]


@pytest.mark.parametrize(("excepted", "stays"), [(0, False), (4, True)])
def test_lost_sticks_matter_in_offboard_unless_excepted(px4_flying, excepted, stays):
    px4_flying.change("COM_RCL_EXCEPT", excepted)
    px4_flying.stream_setpoint(attitude_target(), 0.2)
    assert px4_flying.set_mode(OFFBOARD) == ACCEPTED
    px4_flying.stream_setpoint(attitude_target(), 2.0)
    assert (px4_flying.mode() == custom(OFFBOARD)) == stays


def both(px4, message):
    def send(_):
        px4.send(message)
        px4.sticks(MID)

    return send


def test_offboard_needs_a_setpoint_in_flight(px4_flying):
    px4_flying.fly(1.2)  # a setpoint of the flight before may still count
    assert px4_flying.set_mode(OFFBOARD) == REJECTED
    text = "Switching to Offboard is currently not available"
    assert not px4_flying.hears(text, 1.2, px4_flying.holding()), "only a ground station is told"
    px4_flying.send(attitude_target())
    px4_flying.advance(0.3)
    assert px4_flying.set_mode(OFFBOARD) == ACCEPTED, "one setpoint within a second is enough"


def test_a_lost_stream_leaves_offboard_and_its_return_brings_it_back(px4_flying):
    px4_flying.repeat(both(px4_flying, attitude_target(10.0)), 0.3)
    assert px4_flying.set_mode(OFFBOARD) == ACCEPTED
    messages = px4_flying.repeat(both(px4_flying, attitude_target(10.0)), 1.5)
    assert math.degrees(named(messages, "ATTITUDE")[-1].roll) == pytest.approx(10.0, abs=1.0)
    assert 0.95 <= goes_to(px4_flying, POSCTL, 2.0, px4_flying.holding()) <= 1.25
    assert modes_in(px4_flying.fly(1.0))[-1].intended_custom_mode == custom(OFFBOARD)
    assert goes_to(px4_flying, OFFBOARD, 1.0, both(px4_flying, attitude_target())) < 0.2


def test_without_sticks_a_lost_stream_returns_at_once(px4_grounded):
    take_off_by_setpoints(px4_grounded)
    assert 0.95 <= goes_to(px4_grounded, RTL, 2.0) <= 1.25
    assert px4_grounded.hears("Failsafe activated")


def test_a_mode_command_keeps_a_stream_from_pulling_back(px4_flying):
    px4_flying.repeat(both(px4_flying, attitude_target()), 0.3)
    assert px4_flying.set_mode(OFFBOARD) == ACCEPTED
    px4_flying.repeat(both(px4_flying, attitude_target()), 0.5)
    assert px4_flying.command(mav.MAV_CMD_DO_SET_MODE, 1, *LOITER, system_id=42) == ACCEPTED
    px4_flying.repeat(both(px4_flying, attitude_target()), 1.0)
    assert px4_flying.mode() == custom(LOITER)


@pytest.mark.parametrize(("hz", "stays"), [(1.5, True), (0.8, False)])
def test_offboard_needs_more_than_one_setpoint_a_second(px4_flying, hz, stays):
    px4_flying.repeat(both(px4_flying, attitude_target()), 0.3)
    assert px4_flying.set_mode(OFFBOARD) == ACCEPTED
    due_s = [0.0]

    def send(elapsed_s: float) -> None:
        px4_flying.sticks(MID)
        if elapsed_s >= due_s[0]:
            due_s[0] += 1.0 / hz
            px4_flying.send(attitude_target())

    px4_flying.repeat(send, 0.1)  # a CURRENT_MODE of before may still be on its way
    messages = px4_flying.repeat(send, 4.0)
    modes = {m.custom_mode for m in modes_in(messages)}
    assert (modes == {custom(OFFBOARD)}) == stays
