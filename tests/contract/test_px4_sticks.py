"""MANUAL_CONTROL as PX4's stick input: echo, ranges, arming gates, and what sticks do."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import REBOOT_FORCE
from helpers.px4_companion import (
    ACCEPTED,
    ALTCTL,
    LOITER,
    MID,
    POSCTL,
    REJECTED,
    RTL,
    STAB,
    named,
)

ARM = mav.MAV_CMD_COMPONENT_ARM_DISARM


def echoes(messages):
    return [(m.x, m.y, m.z, m.r) for m in named(messages, "MANUAL_CONTROL")]


@pytest.mark.parametrize(
    ("sent", "used"),
    [
        ((100, -200, 700, 300), (100, -200, 700, 300)),
        ((0, 0, -1, 0), (0, 0, 500, 0)),
        ((0, 0, 1001, 0), (0, 0, 500, 0)),
        ((0, 0, 32767, 0), (0, 0, 500, 0)),
        ((1001, 500, 500, 0), (0, 500, 500, 0)),
        ((32767, -1001, 500, 32767), (0, 0, 500, 0)),
    ],
)
def test_a_field_out_of_range_is_centred(px4, sent, used):
    px4.stream(mav.MAVLINK_MSG_ID_MANUAL_CONTROL, 50)
    echo = echoes(px4.fly(0.5, sent))[-1]
    assert echo == pytest.approx(used, abs=1)


@pytest.mark.parametrize("system_id", [255, 254, 42, 1])
def test_sticks_are_taken_from_any_system(px4, system_id):
    px4.stream(mav.MAVLINK_MSG_ID_MANUAL_CONTROL, 50)
    messages = px4.repeat(lambda _: px4.sticks((300, 0, 500, 0), system_id=system_id), 0.5)
    assert echoes(messages)[-1][0] == pytest.approx(300, abs=1)


def test_the_echo_comes_at_the_senders_rate_and_stops_when_the_sticks_are_lost(px4):
    px4.stream(mav.MAVLINK_MSG_ID_MANUAL_CONTROL, 250)
    px4.fly(0.5)
    sent = []
    messages = px4.repeat(lambda at_s: sent.append(at_s) or px4.sticks(MID), 2.0)
    messages += px4.advance(1.0)
    assert len(echoes(messages)) == pytest.approx(len(sent), abs=6)
    assert not echoes(px4.advance(1.0))


@pytest.mark.parametrize("in_mode", [0, 4])
def test_some_input_modes_ignore_mavlinks_sticks(px4, in_mode):
    px4.change("COM_RC_IN_MODE", in_mode)
    px4.stream(mav.MAVLINK_MSG_ID_MANUAL_CONTROL, 50)
    px4.advance(1.0)
    assert not echoes(px4.fly(0.5))


@pytest.mark.parametrize("mode", [STAB, ALTCTL, POSCTL])
def test_without_sticks_their_modes_do_not_arm(px4_armable, mode):
    px4_armable.get_ready(LOITER)
    px4_armable.advance(1.0)
    assert px4_armable.set_mode(mode) == ACCEPTED, "disarmed, every mode is taken"
    px4_armable.seen.clear()
    assert px4_armable.arm() == REJECTED
    assert px4_armable.hears("Arming denied: Resolve system health failures first")


def test_hold_arms_without_sticks_and_return_does_not(px4_armable):
    px4_armable.get_ready(LOITER)
    px4_armable.advance(1.0)
    assert px4_armable.arm() == ACCEPTED
    assert px4_armable.command(ARM, 1) == ACCEPTED, "arming twice"
    assert px4_armable.command(ARM, 0) == ACCEPTED
    px4_armable.set_mode(RTL)
    assert px4_armable.arm() == REJECTED


@pytest.mark.parametrize(
    ("mode", "z", "result"),
    [
        (STAB, 0, ACCEPTED),
        (STAB, 50, ACCEPTED),
        (STAB, 150, REJECTED),
        (ALTCTL, 0, ACCEPTED),
        (ALTCTL, 500, ACCEPTED),
        (ALTCTL, 1000, REJECTED),
        (POSCTL, 500, ACCEPTED),
        (POSCTL, 700, REJECTED),
    ],
)
def test_arming_needs_a_low_throttle(px4_armable, mode, z, result):
    px4_armable.get_ready(mode)
    sticks = (500, -500, z, 0)  # the others may be anywhere
    px4_armable.fly(0.3, sticks)
    px4_armable.seen.clear()
    assert px4_armable.arm() == result
    denied = px4_armable.hears(
        "Arming denied: throttle not in safe position", 0.7, px4_armable.holding(sticks)
    )
    assert denied == (result == REJECTED)


def test_an_idle_vehicle_is_disarmed(px4_armable):
    px4_armable.change("COM_DISARM_PRFLT", 4.0)
    px4_armable.get_ready(ALTCTL)
    assert px4_armable.arm() == ACCEPTED
    took_s, _ = px4_armable.until(
        lambda m: any("Disarmed" in x.text for x in named(m, "STATUSTEXT")),
        8.0,
        px4_armable.holding(),
    )
    assert 3.8 <= took_s <= 5.5


def test_a_reboot_is_denied_while_armed_even_by_force(px4_armable):
    px4_armable.get_ready(ALTCTL)
    assert px4_armable.arm() == ACCEPTED
    px4_armable.fly(0.2)
    reboot = mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN
    assert px4_armable.command(reboot, 1) == mav.MAV_RESULT_DENIED
    assert px4_armable.command(reboot, 1, 0, 0, 0, 0, REBOOT_FORCE) == mav.MAV_RESULT_DENIED
    assert px4_armable.command(reboot, 0) == ACCEPTED, "which asks for nothing"


@pytest.mark.parametrize(
    ("sticks", "axis", "expected_deg"),
    [
        ((0, 500, 500, 0), "roll", 19.3),
        ((0, 1000, 500, 0), "roll", 35.0),
        ((0, 100, 500, 0), "roll", 4.0),
        ((500, 0, 500, 0), "pitch", -19.3),
    ],
)
def test_altctl_leans_by_the_tangent(px4_flying, sticks, axis, expected_deg):
    attitude = named(px4_flying.fly(1.5, sticks), "ATTITUDE")[-1]
    assert math.degrees(getattr(attitude, axis)) == pytest.approx(expected_deg, abs=1.0)


@pytest.mark.parametrize(("r", "expected_degps"), [(100, 0.0), (500, 34.5), (1000, 145.0)])
def test_yaw_has_a_dead_zone_and_an_expo(px4_flying, r, expected_degps):
    px4_flying.fly(1.5, (0, 0, 500, r))
    attitudes = named(px4_flying.fly(0.5, (0, 0, 500, r)), "ATTITUDE")
    turned = math.remainder(attitudes[-1].yaw - attitudes[0].yaw, 2 * math.pi)
    span_s = (attitudes[-1].time_boot_ms - attitudes[0].time_boot_ms) / 1e3
    assert math.degrees(turned) / span_s == pytest.approx(expected_degps, abs=3.0 + 0.005 * r)


@pytest.mark.parametrize(("z", "low_mps", "high_mps"), [(550, -0.25, 0.25), (750, 0.45, 0.95)])
def test_throttle_is_a_climb_rate_with_a_dead_zone(px4_flying, z, low_mps, high_mps):
    messages = px4_flying.fly(2.5, (0, 0, z, 0))
    positions = named(messages, "LOCAL_POSITION_NED")[-25:]
    climb_mps = -sum(m.vz for m in positions) / len(positions)
    assert low_mps <= climb_mps <= high_mps


def test_a_lean_comes_an_eighth_of_a_second_after_the_stick(px4_flying):
    px4_flying.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 250)
    px4_flying.fly(1.0)
    lags_ms = []
    for _ in range(3):
        begin_ms = named(px4_flying.seen, "ATTITUDE")[-1].time_boot_ms
        attitudes = named(px4_flying.fly(0.5, (0, 500, 500, 0)), "ATTITUDE")
        lags_ms.append(next(m.time_boot_ms for m in attitudes if m.roll > math.radians(2.0)))
        lags_ms[-1] -= begin_ms
        px4_flying.fly(1.5)
    assert sorted(lags_ms)[1] == pytest.approx(143, abs=25)


def test_in_flight_only_a_forced_disarm_works(px4_expendable):
    assert px4_expendable.command(ARM, 0) == REJECTED
    assert px4_expendable.hears("Disarming denied: not landed", 2.0, px4_expendable.holding())
    assert px4_expendable.command(ARM, 0, 21196, system_id=42) == ACCEPTED
