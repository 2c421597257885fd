"""The MAVLink edge on bytes: streams, parameters, refusals, garbage, faults."""

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import named
from helpers.ends import Ends
from sitl.ardupilot.endpoint import ArduPilotTelemetry
from sitl.ardupilot.flight_modes import Mode
from sitl.clock import NS_PER_MS
from sitl.simulated_vehicle import SimulatedVehicle


def test_only_heartbeats_come_without_a_request(station):
    assert [m.get_type() for m in station.run(10.5)] == ["HEARTBEAT"] * 10


def test_intervals_belong_to_the_link_they_came_on():
    station = Ends(links=2)
    station.interval(mav.MAVLINK_MSG_ID_ATTITUDE, 100, link=1)
    assert not named(station.run(0.5, link=0), "ATTITUDE")
    assert len(named(station.run(0.5, link=1), "ATTITUDE")) >= 49


def test_texts_go_to_all_links():
    station = Ends(links=2)
    station.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1, 21196, link=0)
    (text,) = named(station.run(0.1, link=1), "STATUSTEXT")
    assert text.text == "Arming motors"


@pytest.mark.parametrize("message_id", sorted(ArduPilotTelemetry.names))
def test_every_message_packs_with_its_time(station, message_id):
    station.run(6.0)
    station.interval(message_id, 50)
    name = mav.mavlink_map[message_id].msgname
    messages = named(station.run(0.2), name)
    without_setpoint = mav.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED
    assert bool(messages) != (message_id == without_setpoint)
    for message in messages:
        stamp_ms = getattr(message, "time_boot_ms", station.now_ns // NS_PER_MS)
        assert stamp_ms == pytest.approx(station.now_ns / NS_PER_MS, abs=250)


@pytest.mark.parametrize(
    "message_id", [mav.MAVLINK_MSG_ID_LOCAL_POSITION_NED, mav.MAVLINK_MSG_ID_GLOBAL_POSITION_INT]
)
def test_positions_are_withheld_until_the_estimator_has_one(station, message_id):
    station.interval(message_id, 50)
    name = mav.mavlink_map[message_id].msgname
    assert not named(station.run(4.9), name)
    assert named(station.run(0.2), name)


def test_nan_in_a_message_is_refused_and_counted(station):
    station.send(mav.MAVLink_param_set_message(1, 1, b"RC_OVERRIDE_TIME", math.nan, 9))
    assert not named(station.run(0.1), "PARAM_VALUE")
    assert station.vehicle.params["RC_OVERRIDE_TIME"] == 3.0
    assert station.vehicle.log.refused_messages == 1


@pytest.mark.parametrize(
    ("number", "params", "result"),
    [
        (mav.MAV_CMD_SET_MESSAGE_INTERVAL, (30, math.nan), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_DO_SET_MODE, (1, math.nan), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_DO_SET_MODE, (0, 2), mav.MAV_RESULT_DENIED),
        (mav.MAV_CMD_DO_SET_MODE, (1, 77), mav.MAV_RESULT_FAILED),
        (mav.MAV_CMD_COMPONENT_ARM_DISARM, (math.nan,), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_REQUEST_MESSAGE, (148,), mav.MAV_RESULT_ACCEPTED),
        (mav.MAV_CMD_REQUEST_MESSAGE, (331,), mav.MAV_RESULT_FAILED),
        (mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, (1,), mav.MAV_RESULT_ACCEPTED),
        (mav.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN, (2,), mav.MAV_RESULT_UNSUPPORTED),
        (mav.MAV_CMD_NAV_TAKEOFF, (), mav.MAV_RESULT_FAILED),
    ],
)
def test_command_results(station, number, params, result):
    assert station.command(number, *params) == result


@settings(max_examples=60, deadline=None)
@given(st.lists(st.binary(max_size=300), max_size=8))
def test_garbage_never_raises_and_a_good_frame_still_gets_through(chunks):
    vehicle = SimulatedVehicle(links=1, boot_ns=0)
    for chunk in chunks:
        vehicle.receive(0, chunk, 0)
    ping = mav.MAVLink_timesync_message(0, 77).pack(mav.MAVLink(None, srcSystem=255))
    for _ in range(30):  # an open frame of garbage may swallow up to 280 bytes
        vehicle.receive(0, ping, 0)
    answers = mav.MAVLink(None).parse_buffer(vehicle.take_outgoing(0)) or []
    assert any(m.get_type() == "TIMESYNC" and m.ts1 == 77 for m in answers)


def test_the_report_counts_the_setpoints_that_were_followed(station):
    station.run(6.0)
    message = mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.5)
    for mode in (Mode.ALT_HOLD, Mode.GUIDED_NOGPS):
        station.command(mav.MAV_CMD_DO_SET_MODE, 1, mode)
        for _ in range(5):
            station.send(message)
            station.run(0.02)
    vehicle = station.vehicle
    assert vehicle.log.summary(vehicle.ap)["setpoints"] == 5


@pytest.mark.parametrize(
    ("number", "mode"),
    [(mav.MAV_CMD_NAV_LAND, Mode.LAND), (mav.MAV_CMD_NAV_RETURN_TO_LAUNCH, Mode.RTL)],
)
def test_a_station_lands_it_and_calls_it_home(station, number, mode):
    station.run(6.0)
    station.command(number)
    station.run(0.1)
    assert station.vehicle.ap.mode is mode


def test_a_station_joystick_overrides_the_sticks(station):
    station.send(mav.MAVLink_manual_control_message(1, 1000, -1000, 250, 0, 0))
    station.run(0.1)
    assert list(station.vehicle.ap.rc.channels_us[:4]) == [1000, 1000, 1250, 1500]
    assert station.vehicle.log.manual_controls == 1
