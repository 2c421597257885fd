"""Setpoints in GUIDED and GUIDED_NOGPS as measured on ArduCopter; for any peer."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import ARM, FORCE, is_armed, last, named, texts_in, velocity_target
from helpers.copter_companion import (
    ACCEPTED,
    ALT_HOLD,
    FAILED,
    GUIDED,
    GUIDED_NOGPS,
    LAND,
    RTL,
)
from sitl.vehicle.rotation import from_euler

ATTITUDE_MASK, RATES_MASK = 7, 128
HOLD_HEIGHT = 0.5  # thrust without bit 3 of GUID_OPTIONS
STREAMED = (
    mav.MAVLINK_MSG_ID_ATTITUDE,
    mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
    mav.MAVLINK_MSG_ID_ATTITUDE_TARGET,
    mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED,
)


def attitude(roll_deg=0.0, yaw_deg=0.0, *, thrust=HOLD_HEIGHT, mask=ATTITUDE_MASK, norm=1.0):
    q = [norm * x for x in from_euler(math.radians(roll_deg), 0.0, math.radians(yaw_deg))]
    return mav.MAVLink_set_attitude_target_message(0, 1, 1, mask, q, 0.0, 0.0, 0.0, thrust)


def rates(roll_degps=0.0, *, mask=RATES_MASK):
    body = (math.radians(roll_degps), 0.0, 0.0)
    return mav.MAVLink_set_attitude_target_message(0, 1, 1, mask, [0.0] * 4, *body, HOLD_HEIGHT)


def stream(companion, message, seconds, system_id=255):
    """Send the setpoint at 50 Hz; what came in meanwhile."""
    messages = []
    for _ in range(round(50.0 * seconds)):
        companion.send(message, system_id=system_id)
        messages += companion.advance(0.02)
    return messages


def roll_deg(messages):
    return math.degrees(last(messages, "ATTITUDE").roll)


def yaw_deg(messages):
    return math.degrees(last(messages, "ATTITUDE").yaw)


def speed_ned(messages):
    state = last(messages, "LOCAL_POSITION_NED")
    return state.vx, state.vy, state.vz


def armed_on_the_ground(companion, mode):
    for message_id in STREAMED:
        companion.stream(message_id, 50)
    companion.get_ready(mode, needs_position=True)
    assert companion.arm() == ACCEPTED


def in_the_air(companion, mode=GUIDED):
    """Some metres up, still, in the mode; targets are streamed too."""
    for message_id in STREAMED[2:]:
        companion.stream(message_id, 50)
    assert companion.set_mode(mode) == ACCEPTED


@pytest.mark.parametrize("mode", [GUIDED, GUIDED_NOGPS])
def test_a_lean_is_reached_in_its_time_and_beyond_angle_max(flying, mode):
    in_the_air(flying, mode)
    level = stream(flying, attitude(yaw_deg=yaw_deg(flying.advance(0.1))), 1.0)
    heading = yaw_deg(level)
    start_ms = last(level, "ATTITUDE").time_boot_ms
    messages = stream(flying, attitude(10.0, heading), 1.0)
    reached_ms = next(
        m.time_boot_ms for m in named(messages, "ATTITUDE") if math.degrees(m.roll) >= 6.3
    )
    assert 120 <= reached_ms - start_ms <= 270
    assert roll_deg(messages) == pytest.approx(10.0, abs=0.5)
    assert roll_deg(stream(flying, attitude(45.0, heading), 0.8)) == pytest.approx(45.0, abs=3.0)


@pytest.mark.parametrize("mode", [GUIDED, GUIDED_NOGPS])
def test_setpoints_of_any_system_are_followed_without_an_answer(flying, mode):
    in_the_air(flying, mode)
    heading = yaw_deg(flying.advance(0.1))
    messages = stream(flying, attitude(10.0, heading), 1.0, system_id=42)
    assert roll_deg(messages) == pytest.approx(10.0, abs=1.5)
    assert not named(messages, "COMMAND_ACK")
    assert not [text for text in texts_in(messages) if "EKF" not in text]


def test_other_modes_ignore_setpoints(flying):
    in_the_air(flying, ALT_HOLD)
    flying.hold(0.5)
    flying.send(attitude(20.0))
    flying.send(velocity_target(3.0))
    messages = flying.hold(1.5)
    assert roll_deg(messages) == pytest.approx(0.0, abs=1.5)


def test_rates_turn_and_without_rates_or_attitude_it_keeps_its_attitude(flying):
    in_the_air(flying, GUIDED_NOGPS)
    stream(flying, attitude(), 1.0)
    turned = stream(flying, rates(40.0), 0.5)
    assert math.degrees(last(turned, "ATTITUDE").rollspeed) == pytest.approx(40.0, abs=6.0)
    start = stream(flying, rates(mask=135), 0.5)
    end = stream(flying, rates(mask=135), 0.5)
    assert roll_deg(end) == pytest.approx(roll_deg(start), abs=1.5)
    assert roll_deg(end) > 15.0


@pytest.mark.parametrize(
    "invalid",
    [
        attitude(20.0, mask=ATTITUDE_MASK | 64),
        attitude(20.0, mask=1),
        attitude(20.0, norm=1.002),
        rates(20.0, mask=192),
    ],
    ids=["thrust ignored", "one rate ignored", "no unit quaternion", "neither"],
)
def test_an_invalid_setpoint_brakes_in_guided_and_is_forgotten_in_nogps(flying, invalid):
    in_the_air(flying, GUIDED)
    stream(flying, attitude(10.0), 0.8)
    braked = stream(flying, invalid, 1.0)
    assert roll_deg(braked) < 2.0
    assert named(braked[-20:], "POSITION_TARGET_LOCAL_NED")
    assert flying.set_mode(GUIDED_NOGPS) == ACCEPTED
    stream(flying, attitude(10.0), 0.8)
    assert roll_deg(stream(flying, invalid, 0.6)) == pytest.approx(10.0, abs=1.5)


@pytest.mark.parametrize("mode", [GUIDED, GUIDED_NOGPS])
def test_a_stream_that_stops_is_held_and_resumes_at_once(flying, mode):
    in_the_air(flying, mode)
    flying.set_param("GUID_TIMEOUT", 1.0)
    stream(flying, attitude(10.0), 0.8)
    assert roll_deg(flying.advance(0.8)) == pytest.approx(10.0, abs=1.0)
    levelled = flying.advance(1.2)
    assert abs(roll_deg(levelled)) < 2.0
    assert abs(speed_ned(levelled)[2]) < 0.3
    assert roll_deg(stream(flying, attitude(10.0), 0.6)) > 8.0


@pytest.mark.parametrize(
    ("options", "thrust", "climb_mps"),
    [(0, 0.5, 0.0), (0, 0.6, 0.5), (0, 0.0, -1.5), (8, 1.0, 3.0)],
)
def test_thrust_is_a_climb_rate_unless_an_option_makes_it_a_collective(
    flying, options, thrust, climb_mps
):
    in_the_air(flying, GUIDED_NOGPS)
    flying.set_param("GUID_OPTIONS", options)
    messages = stream(flying, attitude(thrust=thrust), 0.6 if options else 2.5)
    climb = -speed_ned(messages)[2]
    assert climb > climb_mps if options else climb == pytest.approx(climb_mps, abs=0.15)


def test_a_thrust_lifts_off_sticks_do_nothing_and_in_flight_only_a_forced_disarm_works(grounded):
    armed_on_the_ground(grounded, GUIDED_NOGPS)
    start_m = last(grounded.advance(0.2), "LOCAL_POSITION_NED").z
    stream(grounded, attitude(thrust=0.8), 5.5)
    grounded.override(1900, 1900, 1900, 1900)
    messages = stream(grounded, attitude(), 1.5)
    assert start_m - last(messages, "LOCAL_POSITION_NED").z > 2.0
    assert abs(roll_deg(messages)) < 1.5
    assert abs(speed_ned(messages)[2]) < 0.3
    grounded.stream(mav.MAVLINK_MSG_ID_HEARTBEAT, 10)
    assert grounded.command(ARM, 0) == FAILED
    assert is_armed(grounded.wait("HEARTBEAT"))
    assert grounded.command(ARM, 0, FORCE, system_id=42) == ACCEPTED
    assert not is_armed(last(grounded.advance(0.5), "HEARTBEAT"))


@pytest.mark.parametrize(
    ("frame", "is_body"),
    [
        (mav.MAV_FRAME_LOCAL_NED, False),
        (mav.MAV_FRAME_LOCAL_OFFSET_NED, False),
        (mav.MAV_FRAME_BODY_NED, True),
        (mav.MAV_FRAME_BODY_OFFSET_NED, True),
    ],
)
def test_the_frame_decides_on_the_axes_of_a_velocity(flying, frame, is_body):
    in_the_air(flying)
    if not 80.0 < yaw_deg(flying.advance(0.1)) < 100.0:  # else the frame before has turned it
        stream(flying, attitude(yaw_deg=90.0), 3.0)
    messages = stream(flying, velocity_target(1.0, frame=frame), 3.0)
    heading = math.radians(yaw_deg(messages))
    north, east = (math.cos(heading), math.sin(heading)) if is_body else (1.0, 0.0)
    assert speed_ned(messages)[:2] == pytest.approx((north, east), abs=0.2)
    target = last(messages, "POSITION_TARGET_LOCAL_NED")
    assert target.type_mask == 3079
    assert (target.vx, target.vy) == pytest.approx((north, east), abs=0.05)


def test_velocity_and_yaw_rate_take_their_measured_time(flying):
    in_the_air(flying)
    still = stream(flying, velocity_target(), 1.0)
    start_ms = last(still, "LOCAL_POSITION_NED").time_boot_ms
    messages = stream(flying, velocity_target(2.0), 3.0)
    reached_ms = next(m.time_boot_ms for m in named(messages, "LOCAL_POSITION_NED") if m.vx >= 1.26)
    assert reached_ms - start_ms == pytest.approx(865, abs=120)
    assert speed_ned(messages)[0] == pytest.approx(2.0, abs=0.1)
    turning = stream(flying, velocity_target(yaw_rate_deg=30.0), 2.0)
    assert math.degrees(last(turning, "ATTITUDE").yawspeed) == pytest.approx(30.0, abs=3.0)


def test_a_velocity_that_stops_is_held_until_the_timeout(flying):
    in_the_air(flying)
    flying.set_param("GUID_TIMEOUT", 1.0)
    stream(flying, velocity_target(1.0), 2.5)
    assert speed_ned(flying.advance(0.8))[0] == pytest.approx(1.0, abs=0.15)
    assert math.hypot(*speed_ned(flying.advance(2.2))) < 0.3


def test_a_velocity_does_not_lift_off_and_ends_a_takeoff(grounded):
    armed_on_the_ground(grounded, GUIDED)
    start_m = last(grounded.advance(0.2), "LOCAL_POSITION_NED").z
    assert (
        start_m - last(stream(grounded, velocity_target(vz=-1.0), 3.0), "LOCAL_POSITION_NED").z
        < 0.3
    )
    assert grounded.command(mav.MAV_CMD_NAV_TAKEOFF, *[0] * 6, 8.0) == ACCEPTED
    grounded.advance(3.2)
    messages = stream(grounded, velocity_target(), 3.0)
    assert 1.0 < start_m - last(messages, "LOCAL_POSITION_NED").z < 7.0
    assert grounded.command(mav.MAV_CMD_NAV_TAKEOFF, *[0] * 6, 12.0) == FAILED


def test_a_takeoff_ends_at_its_height_alt_hold_keeps_it_and_land_disarms_on_the_ground(grounded):
    assert grounded.stream(mav.MAVLINK_MSG_ID_EXTENDED_SYS_STATE, 10) == ACCEPTED
    assert grounded.wait("EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_ON_GROUND
    armed_on_the_ground(grounded, GUIDED)
    start = last(grounded.advance(0.2), "LOCAL_POSITION_NED").z
    assert grounded.command(mav.MAV_CMD_NAV_TAKEOFF, *[0] * 6, 5.0) == ACCEPTED
    messages = grounded.hold(5.0)
    while last(messages, "EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_TAKEOFF:
        messages = grounded.hold(1.0)
        assert len(named(grounded.seen, "EXTENDED_SYS_STATE")) < 200, "it climbs on"
    end = last(messages, "LOCAL_POSITION_NED").z
    assert start - end == pytest.approx(5.0, abs=0.7)
    assert last(messages, "EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_IN_AIR
    assert grounded.set_mode(ALT_HOLD) == ACCEPTED
    held = last(grounded.hold(3.0), "LOCAL_POSITION_NED").z
    assert held == pytest.approx(end, abs=0.4)
    grounded.stream(mav.MAVLINK_MSG_ID_HEARTBEAT, 10)
    speed = grounded.read_param("LAND_SPEED", "LAND_SPD_MS")  # cm/s; m/s in ArduCopter 4.8
    grounded.set_param(speed.param_id, 3.0 * speed.param_value)
    assert grounded.set_mode(LAND) == ACCEPTED
    landing = grounded.hold(0.5)
    assert last(landing, "EXTENDED_SYS_STATE").landed_state == mav.MAV_LANDED_STATE_LANDING
    while is_armed(last(landing, "HEARTBEAT")):
        landing = grounded.hold(0.5)
        assert len(named(grounded.seen, "EXTENDED_SYS_STATE")) < 350, "still armed"
    assert start - last(landing, "LOCAL_POSITION_NED").z < 1.0


def test_attitude_target_has_the_shaped_target_and_the_thrust(flying):
    for message_id in STREAMED:
        flying.stream(message_id, 100)
    # After a flight that was ended in the air the firmware keeps its last thrust; the mock has 0.
    assert flying.wait("ATTITUDE_TARGET").type_mask == 0
    in_the_air(flying, GUIDED_NOGPS)
    heading = yaw_deg(stream(flying, attitude(), 2.0))
    messages = stream(flying, attitude(10.0, heading), 0.1)
    target = last(messages, "ATTITUDE_TARGET")
    rolled_deg = 2.0 * math.degrees(math.asin(target.q[1]))
    assert 0.5 < rolled_deg < 8.0
    assert math.degrees(target.body_roll_rate) > 20.0
    assert 0.2 < target.thrust < 0.6


@pytest.mark.parametrize(
    ("options", "mode", "text"),
    [
        (None, RTL, "Radio Failsafe"),
        (4, GUIDED_NOGPS, "Radio Failsafe - Continuing Guided Mode"),
    ],
)
def test_without_receiver_setpoints_alone_need_an_option(without_receiver, options, mode, text):
    companion = without_receiver
    companion.fly_up(GUIDED_NOGPS)
    companion.override(1500, 1500, 1500, 1500)
    if options is not None:
        companion.set_param("FS_OPTIONS", options)
    messages = stream(companion, attitude(), 2.6)
    assert [each for each in texts_in(messages) if "Failsafe" in each] == [text]
    assert last(messages, "HEARTBEAT").custom_mode == mode


def test_without_receiver_and_its_failsafe_setpoints_alone_arm_and_fly(without_receiver):
    companion = without_receiver
    if companion.is_external:
        pytest.skip("a real vehicle has had sticks since it booted")
    for message_id in STREAMED:
        companion.stream(message_id, 50)
    companion.advance(4.0)
    assert companion.set_mode(GUIDED_NOGPS) == ACCEPTED
    assert companion.arm() == FAILED
    companion.set_param("FS_THR_ENABLE", 0)
    assert companion.arm() == ACCEPTED
    messages = stream(companion, attitude(thrust=0.8), 6.0)
    assert last(messages, "LOCAL_POSITION_NED").z < -1.0
