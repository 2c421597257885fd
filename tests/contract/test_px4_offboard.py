"""OFFBOARD: what setpoints do, their echoes, and the firmware's own take-off, hold and landing."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import velocity_target
from helpers.px4_companion import (
    ACCEPTED,
    LAND,
    LOITER,
    OFFBOARD,
    TAKEOFF,
    attitude_target,
    custom,
    named,
    rate_target,
)


@pytest.fixture
def offboard(px4_flying):
    """Some metres up in OFFBOARD, holding its place without sticks."""
    px4_flying.change("COM_RCL_EXCEPT", 4)
    px4_flying.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 250)
    px4_flying.stream_setpoint(velocity_target(), 0.3)
    assert px4_flying.set_mode(OFFBOARD) == ACCEPTED
    px4_flying.stream_setpoint(velocity_target(), 1.0)
    return px4_flying


def crossings_ms(samples, begin_ms, start, target):
    """Milliseconds to 10, 50, 63 and 90 % of a step; samples are (time ms, value)."""
    times = []
    for share in (0.1, 0.5, 0.63, 0.9):
        reached = (t for t, v in samples if (v - start) / (target - start) >= share)
        times.append(next(reached) - begin_ms)
    return times


def heading(px4):
    return named(px4.seen, "ATTITUDE")[-1].yaw


def test_a_step_of_attitude_takes_as_long_as_measured(offboard):
    yaw = heading(offboard)
    offboard.stream_setpoint(attitude_target(yaw=yaw), 1.5, hz=100)
    begin = named(offboard.seen, "ATTITUDE")[-1]
    messages = offboard.stream_setpoint(attitude_target(10.0, yaw=yaw), 1.2, hz=100)
    samples = [(m.time_boot_ms, math.degrees(m.roll)) for m in named(messages, "ATTITUDE")]
    times = crossings_ms(samples, begin.time_boot_ms, math.degrees(begin.roll), 10.0)
    assert times == [
        pytest.approx(130, abs=30),
        pytest.approx(260, abs=30),
        pytest.approx(300, abs=30),
        pytest.approx(455, abs=60),
    ]
    assert samples[-1][1] == pytest.approx(10.0, abs=0.7)


def test_rates_are_followed(offboard):
    offboard.stream_setpoint(attitude_target(yaw=heading(offboard)), 1.0, hz=100)
    messages = offboard.stream_setpoint(rate_target(40.0), 1.5, hz=100)
    rates = [math.degrees(m.yawspeed) for m in named(messages, "ATTITUDE")[-60:]]
    assert sum(rates) / len(rates) == pytest.approx(40.0, abs=5.0)


def test_a_velocity_is_approached_within_a_second(offboard):
    messages = offboard.stream_setpoint(velocity_target(vx=3.0), 3.0)
    positions = named(messages, "LOCAL_POSITION_NED")
    begin_ms = positions[0].time_boot_ms

    def speed_at(seconds):
        return min(positions, key=lambda m: abs(m.time_boot_ms - begin_ms - 1e3 * seconds)).vx

    assert speed_at(0.2) < 0.35
    assert speed_at(0.5) == pytest.approx(0.9, abs=0.4)
    assert speed_at(1.0) == pytest.approx(1.9, abs=0.4)
    assert speed_at(2.9) == pytest.approx(2.3, abs=0.4)


def test_a_body_velocity_turns_with_the_heading(offboard):
    offboard.stream_setpoint(velocity_target(yaw_rate_deg=45.0), 2.5)
    offboard.stream_setpoint(velocity_target(), 1.0)
    yaw = heading(offboard)
    frame = mav.MAV_FRAME_BODY_NED
    messages = offboard.stream_setpoint(velocity_target(vx=2.0, frame=frame), 2.5)
    last = named(messages, "LOCAL_POSITION_NED")[-1]
    assert abs(yaw) > 1.0
    assert math.remainder(math.atan2(last.vy, last.vx) - yaw, 2 * math.pi) == pytest.approx(
        0.0, abs=0.2
    )


def test_the_attitude_target_echoes_the_setpoint(offboard):
    yaw = heading(offboard)
    assert offboard.stream(mav.MAVLINK_MSG_ID_ATTITUDE_TARGET, 50) == ACCEPTED
    target = attitude_target(5.0, thrust=0.5, yaw=yaw)
    messages = offboard.stream_setpoint(target, 1.0, hz=100)
    echo = named(messages, "ATTITUDE_TARGET")[-1]
    assert abs(sum(a * b for a, b in zip(echo.q, target.q, strict=True))) > 0.9999
    assert echo.thrust == pytest.approx(0.5, abs=0.01)
    assert echo.type_mask == 0


def test_the_position_target_echoes_a_velocity(offboard):
    assert offboard.stream(mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED, 50) == ACCEPTED
    messages = offboard.stream_setpoint(velocity_target(1.0, -0.5, -0.2, 20.0), 1.0)
    echo = named(messages, "POSITION_TARGET_LOCAL_NED")[-1]
    assert (echo.vx, echo.vy, echo.vz) == pytest.approx((1.0, -0.5, -0.2), abs=0.01)
    assert math.degrees(echo.yaw_rate) == pytest.approx(20.0, abs=0.5)


def has_said(text):
    return lambda messages: any(text in m.text for m in named(messages, "STATUSTEXT"))


def test_the_vehicle_takes_off_holds_and_lands_by_itself(px4_grounded):
    px4_grounded.change("MPC_LAND_SPEED", 1.2)
    px4_grounded.track()
    px4_grounded.get_ready(LOITER)
    ground = named(px4_grounded.seen, "LOCAL_POSITION_NED")[-1].z
    assert px4_grounded.set_mode(TAKEOFF) == ACCEPTED
    assert px4_grounded.arm() == ACCEPTED
    px4_grounded.until(
        lambda m: any(x.landed_state == 2 for x in named(m, "EXTENDED_SYS_STATE")),
        20.0,
        px4_grounded.holding(),
    )
    messages = px4_grounded.fly(2.0)
    height = ground - named(messages, "LOCAL_POSITION_NED")[-1].z
    assert px4_grounded.mode() == custom(LOITER)
    assert height == pytest.approx(2.5, abs=0.8)
    assert px4_grounded.set_mode(LAND) == ACCEPTED
    px4_grounded.until(has_said("Landing detected"), 20.0, px4_grounded.holding())
    disarmed = has_said("Disarmed by landing")
    took_s, _ = px4_grounded.until(disarmed, 5.0, px4_grounded.holding())
    assert 1.7 <= took_s <= 2.6
    px4_grounded.fly(0.5)
    assert px4_grounded.mode() == custom(LOITER), "the last one that can arm"
