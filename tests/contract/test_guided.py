"""Setpoints in GUIDED and GUIDED_NOGPS as measured on ArduCopter; for any peer."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.rotation import from_euler

ALT_HOLD, GUIDED, RTL, GUIDED_NOGPS = 2, 4, 6, 20
ACCEPTED, FAILED = mav.MAV_RESULT_ACCEPTED, mav.MAV_RESULT_FAILED
ATTITUDE_MASK, RATES_MASK, VELOCITY_MASK = 7, 128, 1479
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


def rates(roll_degps=0.0, yaw_degps=0.0, *, thrust=HOLD_HEIGHT, mask=RATES_MASK):
    body = (math.radians(roll_degps), 0.0, math.radians(yaw_degps))
    return mav.MAVLink_set_attitude_target_message(0, 1, 1, mask, [0.0] * 4, *body, thrust)


def velocity(x=0.0, y=0.0, z=0.0, *, yaw_degps=0.0, frame=mav.MAV_FRAME_LOCAL_NED):
    return mav.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, frame, VELOCITY_MASK, 0, 0, 0, x, y, z, 0, 0, 0, 0, math.radians(yaw_degps)
    )


def stream(companion, message, seconds, system_id=255):
    """Send the setpoint at 50 Hz; what came in meanwhile."""
    messages = []
    for _ in range(round(50.0 * seconds)):
        companion.send(message, system_id=system_id)
        messages += companion.advance(0.02)
    return messages


def named(messages, name):
    return [message for message in messages if message.get_type() == name]


def last(messages, name):
    return named(messages, name)[-1]


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
    companion.get_ready(mode)
    for _ in range(60):
        if named(companion.hold(1.0, thr=1000), "LOCAL_POSITION_NED"):
            break
    assert companion.arm() == ACCEPTED


def take_off(companion, mode=GUIDED, height_m=5.0):
    """To some metres in GUIDED, then the mode."""
    armed_on_the_ground(companion, GUIDED)
    assert companion.command(mav.MAV_CMD_NAV_TAKEOFF, *[0] * 6, height_m) == ACCEPTED
    companion.advance(10.0)
    if mode != GUIDED:
        assert companion.set_mode(mode) == ACCEPTED


@pytest.mark.parametrize("mode", [GUIDED, GUIDED_NOGPS])
def test_a_lean_is_reached_in_its_time_and_beyond_angle_max(companion, mode):
    take_off(companion, mode)
    level = stream(companion, attitude(yaw_deg=yaw_deg(companion.advance(0.1))), 1.0)
    heading = yaw_deg(level)

    start_ms = last(level, "ATTITUDE").time_boot_ms
    messages = stream(companion, attitude(10.0, heading), 1.5)
    reached_ms = next(
        m.time_boot_ms for m in named(messages, "ATTITUDE") if math.degrees(m.roll) >= 6.3
    )

    assert 120 <= reached_ms - start_ms <= 270
    assert roll_deg(messages) == pytest.approx(10.0, abs=0.5)
    assert roll_deg(stream(companion, attitude(45.0, heading), 0.8)) == pytest.approx(45.0, abs=3.0)


@pytest.mark.parametrize("mode", [GUIDED, GUIDED_NOGPS])
def test_setpoints_of_anybody_are_taken_without_a_word(companion, mode):
    take_off(companion, mode)

    messages = stream(companion, attitude(10.0), 1.0, system_id=42)

    assert roll_deg(messages) == pytest.approx(10.0, abs=1.5)
    assert not named(messages, "COMMAND_ACK")
    assert not [m for m in named(messages, "STATUSTEXT") if "EKF" not in m.text]


def test_other_modes_ignore_setpoints(companion):
    take_off(companion, ALT_HOLD)
    companion.hold(0.5)

    companion.send(attitude(20.0))
    companion.send(velocity(3.0))
    messages = companion.hold(1.5)

    assert roll_deg(messages) == pytest.approx(0.0, abs=1.5)


def test_rates_turn_and_without_rates_or_attitude_it_keeps_its_attitude(companion):
    take_off(companion, GUIDED_NOGPS)
    stream(companion, attitude(), 1.0)

    turned = stream(companion, rates(40.0), 0.5)
    assert math.degrees(last(turned, "ATTITUDE").rollspeed) == pytest.approx(40.0, abs=6.0)

    start = stream(companion, rates(mask=135), 0.5)
    end = stream(companion, rates(mask=135), 0.5)
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
def test_an_invalid_setpoint_brakes_in_guided_and_is_forgotten_in_nogps(companion, invalid):
    take_off(companion, GUIDED)
    stream(companion, attitude(10.0), 1.5)
    braked = stream(companion, invalid, 1.0)
    assert roll_deg(braked) < 2.0
    assert named(braked[-20:], "POSITION_TARGET_LOCAL_NED")

    assert companion.set_mode(GUIDED_NOGPS) == ACCEPTED
    stream(companion, attitude(10.0), 1.5)
    assert roll_deg(stream(companion, invalid, 1.0)) == pytest.approx(10.0, abs=1.5)


@pytest.mark.parametrize("mode", [GUIDED, GUIDED_NOGPS])
def test_a_stream_that_stops_is_held_and_resumes_at_once(companion, mode):
    take_off(companion, mode)
    companion.set_param("GUID_TIMEOUT", 1.0)
    stream(companion, attitude(10.0), 1.5)

    assert roll_deg(companion.advance(0.8)) == pytest.approx(10.0, abs=1.0)
    levelled = companion.advance(1.2)
    assert abs(roll_deg(levelled)) < 2.0
    assert abs(speed_ned(levelled)[2]) < 0.3
    assert roll_deg(stream(companion, attitude(10.0), 0.6)) > 8.0


@pytest.mark.parametrize(
    ("options", "thrust", "climb_mps"),
    [(0, 0.5, 0.0), (0, 0.6, 0.5), (0, 0.0, -1.5), (8, 1.0, 5.0)],
)
def test_thrust_is_a_climb_rate_unless_an_option_says_otherwise(
    companion, options, thrust, climb_mps
):
    take_off(companion, GUIDED_NOGPS, height_m=8.0)
    companion.set_param("GUID_OPTIONS", options)

    messages = stream(companion, attitude(thrust=thrust), 1.0 if options else 3.0)

    climb = -speed_ned(messages)[2]
    assert climb > climb_mps if options else climb == pytest.approx(climb_mps, abs=0.15)


def test_a_thrust_lifts_off_and_sticks_do_nothing(companion):
    armed_on_the_ground(companion, GUIDED_NOGPS)
    start_m = last(companion.advance(0.2), "LOCAL_POSITION_NED").z

    stream(companion, attitude(thrust=0.8), 6.0)
    companion.override(1900, 1900, 1900, 1900)
    messages = stream(companion, attitude(), 2.0)

    assert start_m - last(messages, "LOCAL_POSITION_NED").z > 2.0
    assert abs(roll_deg(messages)) < 1.5
    assert abs(speed_ned(messages)[2]) < 0.3


@pytest.mark.parametrize(
    ("frame", "is_body"),
    [
        (mav.MAV_FRAME_LOCAL_NED, False),
        (mav.MAV_FRAME_LOCAL_OFFSET_NED, False),
        (mav.MAV_FRAME_BODY_NED, True),
        (mav.MAV_FRAME_BODY_OFFSET_NED, True),
    ],
)
def test_the_frame_decides_on_the_axes_of_a_velocity(companion, frame, is_body):
    take_off(companion)
    turned = stream(companion, attitude(yaw_deg=90.0), 3.0)
    heading = math.radians(yaw_deg(turned))

    messages = stream(companion, velocity(1.0, frame=frame), 4.0)

    north, east = (math.cos(heading), math.sin(heading)) if is_body else (1.0, 0.0)
    assert speed_ned(messages)[:2] == pytest.approx((north, east), abs=0.2)
    target = last(messages, "POSITION_TARGET_LOCAL_NED")
    assert target.type_mask == 3079
    assert (target.vx, target.vy) == pytest.approx((north, east), abs=0.05)


@pytest.mark.parametrize("frame", [mav.MAV_FRAME_MISSION, mav.MAV_FRAME_GLOBAL_RELATIVE_ALT])
def test_a_velocity_in_another_frame_brakes(companion, frame):
    take_off(companion)
    assert math.hypot(*speed_ned(stream(companion, velocity(2.0), 3.0))) > 1.8

    stopped = stream(companion, velocity(2.0, frame=frame), 3.0)

    assert math.hypot(*speed_ned(stopped)) < 0.3


def test_velocity_and_yaw_rate_take_their_measured_time(companion):
    take_off(companion)
    still = stream(companion, velocity(), 1.0)
    start_ms = last(still, "LOCAL_POSITION_NED").time_boot_ms

    messages = stream(companion, velocity(2.0), 3.0)
    reached_ms = next(m.time_boot_ms for m in named(messages, "LOCAL_POSITION_NED") if m.vx >= 1.26)
    assert reached_ms - start_ms == pytest.approx(865, abs=120)
    assert speed_ned(messages)[0] == pytest.approx(2.0, abs=0.1)

    turning = stream(companion, velocity(yaw_degps=30.0), 2.0)
    assert math.degrees(last(turning, "ATTITUDE").yawspeed) == pytest.approx(30.0, abs=3.0)


def test_a_velocity_that_stops_is_held_until_the_timeout(companion):
    take_off(companion)
    companion.set_param("GUID_TIMEOUT", 1.0)
    stream(companion, velocity(1.0), 3.0)

    assert speed_ned(companion.advance(0.8))[0] == pytest.approx(1.0, abs=0.15)
    assert math.hypot(*speed_ned(companion.advance(2.5))) < 0.2


def test_a_velocity_does_not_lift_off_and_ends_a_takeoff(companion):
    armed_on_the_ground(companion, GUIDED)
    start_m = last(companion.advance(0.2), "LOCAL_POSITION_NED").z
    assert start_m - last(stream(companion, velocity(z=-1.0), 5.0), "LOCAL_POSITION_NED").z < 0.3

    assert companion.command(mav.MAV_CMD_NAV_TAKEOFF, *[0] * 6, 8.0) == ACCEPTED
    companion.advance(3.2)
    messages = stream(companion, velocity(), 4.0)

    assert 1.0 < start_m - last(messages, "LOCAL_POSITION_NED").z < 7.0
    assert companion.command(mav.MAV_CMD_NAV_TAKEOFF, *[0] * 6, 12.0) == FAILED


def test_a_takeoff_ends_at_its_height_and_alt_hold_keeps_it(companion):
    take_off(companion, height_m=5.0)
    end = last(companion.advance(0.2), "LOCAL_POSITION_NED").z
    assert end == pytest.approx(-5.0, abs=0.7)

    companion.hold(0.2)
    assert companion.set_mode(ALT_HOLD) == ACCEPTED
    held = last(companion.hold(5.0), "LOCAL_POSITION_NED").z

    assert held == pytest.approx(end, abs=0.4)


def test_attitude_target_is_the_shaped_target_and_tells_the_thrust(companion):
    for message_id in STREAMED:
        companion.stream(message_id, 100)
    # After a flight that was ended in the air the firmware keeps its last thrust; the mock has 0.
    assert companion.wait("ATTITUDE_TARGET").type_mask == 0

    take_off(companion, GUIDED_NOGPS)
    heading = yaw_deg(stream(companion, attitude(), 2.0))
    messages = stream(companion, attitude(10.0, heading), 0.1)
    target = last(messages, "ATTITUDE_TARGET")
    rolled_deg = 2.0 * math.degrees(math.asin(target.q[1]))

    assert 0.5 < rolled_deg < 8.0
    assert math.degrees(target.body_roll_rate) > 20.0
    assert 0.2 < target.thrust < 0.6


def test_without_receiver_setpoints_do_not_stop_the_radio_failsafe(companion_without_receiver):
    companion = companion_without_receiver
    take_off_without_receiver(companion)

    messages = stream(companion, attitude(), 1.6)

    assert "Radio Failsafe" in [m.text for m in named(messages, "STATUSTEXT")]
    assert last(messages, "HEARTBEAT").custom_mode == RTL


def test_an_option_lets_guided_go_on_without_sticks(companion_without_receiver):
    companion = companion_without_receiver
    take_off_without_receiver(companion)
    companion.set_param("FS_OPTIONS", 4)

    messages = stream(companion, attitude(), 2.6)

    texts = [m.text for m in named(messages, "STATUSTEXT")]
    assert texts == ["Radio Failsafe - Continuing Guided Mode"]
    assert last(messages, "HEARTBEAT").custom_mode == GUIDED_NOGPS


def take_off_without_receiver(companion):
    """In GUIDED_NOGPS, with overrides until the end."""
    companion.stream(mav.MAVLINK_MSG_ID_HEARTBEAT, 10)
    armed_on_the_ground(companion, GUIDED_NOGPS)
    for _ in range(300):
        companion.override(1500, 1500, 1500, 1500)
        companion.send(attitude(thrust=0.8))
        companion.advance(0.02)


def test_without_receiver_and_its_failsafe_setpoints_alone_arm_and_fly(companion_without_receiver):
    companion = companion_without_receiver
    for message_id in STREAMED:
        companion.stream(message_id, 50)
    companion.advance(4.0)
    assert companion.set_mode(GUIDED_NOGPS) == ACCEPTED
    assert companion.arm() == FAILED

    companion.set_param("FS_THR_ENABLE", 0)
    assert companion.arm() == ACCEPTED
    messages = stream(companion, attitude(thrust=0.8), 6.0)

    assert last(messages, "LOCAL_POSITION_NED").z < -1.0
