"""A link as measured on both firmwares: identity, streams, clock, parameters."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import Companion, named
from helpers.px4_companion import ACCEPTED, Px4Companion

SET_INTERVAL = mav.MAV_CMD_SET_MESSAGE_INTERVAL
SYSTEMS = pytest.mark.parametrize("system_id", [255, 42, 1])


@pytest.fixture(params=["companion", "px4"])
def vehicle(request: pytest.FixtureRequest) -> Companion:
    return request.getfixturevalue(request.param)


def test_heartbeat_names_a_quadrotor_with_its_firmware(vehicle):
    heartbeat = vehicle.wait("HEARTBEAT")
    is_px4 = isinstance(vehicle, Px4Companion)
    assert (heartbeat.get_srcSystem(), heartbeat.get_srcComponent()) == (1, 1)
    assert heartbeat.type == mav.MAV_TYPE_QUADROTOR
    autopilot = mav.MAV_AUTOPILOT_PX4 if is_px4 else mav.MAV_AUTOPILOT_ARDUPILOTMEGA
    assert heartbeat.autopilot == autopilot
    assert heartbeat.get_msgbuf()[0] == 0xFD


def test_interval_minus_one_stops_a_stream(vehicle):
    vehicle.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 100)
    vehicle.wait("ATTITUDE")
    assert vehicle.command(SET_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE, -1) == ACCEPTED
    vehicle.advance(0.1)
    assert not named(vehicle.advance(0.5), "ATTITUDE")


@SYSTEMS
def test_commands_are_taken_from_any_system(vehicle, system_id):
    result = vehicle.command(SET_INTERVAL, mav.MAVLINK_MSG_ID_ATTITUDE, 10_000, system_id=system_id)
    assert result == ACCEPTED


@SYSTEMS
def test_timesync_echoes_the_request_in_the_clock_of_the_telemetry(vehicle, system_id):
    vehicle.stream(mav.MAVLINK_MSG_ID_ATTITUDE, 100)
    vehicle.send(mav.MAVLink_timesync_message(0, 123_456_789_012), system_id=system_id)
    answer = vehicle.wait("TIMESYNC", where=lambda m: m.tc1 != 0 and m.ts1 == 123_456_789_012)
    attitude = vehicle.wait("ATTITUDE")
    assert answer.tc1 % 1000 == 0
    assert attitude.time_boot_ms - answer.tc1 / 1e6 == pytest.approx(10.0, abs=50.0)


def test_a_float_parameter_is_read_and_written(vehicle):
    name = "COM_RC_LOSS_T" if isinstance(vehicle, Px4Companion) else "RC_OVERRIDE_TIME"
    assert vehicle.set_param(name, 2.0) == 2.0
    assert vehicle.get_param(name) == 2.0
