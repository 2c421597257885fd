"""Heartbeats and SYS_STATUS of ArduPilot."""

from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import last
from helpers.ends import Ends
from sitl.ardupilot.flight_modes import Mode
from sitl.vehicle.config import VehicleConfig

WITHOUT_RECEIVER = VehicleConfig(receiver_us=None, estimator_ready_s=0.0, position_ready_s=0.0)
RECEIVER = mav.MAV_SYS_STATUS_SENSOR_RC_RECEIVER


def override(station, *values_us):
    station.send(mav.MAVLink_rc_channels_override_message(1, 1, *values_us, *[65535] * 4))
    return station.run(0.2)


def test_a_radio_failsafe_shows_in_heartbeat_and_receiver_health():
    station = Ends(config=WITHOUT_RECEIVER)
    station.interval(mav.MAVLINK_MSG_ID_SYS_STATUS, 10)
    station.interval(mav.MAVLINK_MSG_ID_HEARTBEAT, 10)
    assert not last(station.run(0.2), "SYS_STATUS").onboard_control_sensors_present & RECEIVER
    override(station, 1500, 1500, 1000, 1500)
    assert station.vehicle.ap.set_mode(Mode.ALT_HOLD)
    assert station.vehicle.ap.arm(force=False)
    for messages, is_healthy, state in (
        (override(station, 1500, 1500, 1000, 1500), True, mav.MAV_STATE_ACTIVE),
        (station.run(1.2), False, mav.MAV_STATE_CRITICAL),
        (override(station, 1500, 1500, 1000, 1500), True, mav.MAV_STATE_STANDBY),
    ):
        status = last(messages, "SYS_STATUS")
        assert status.onboard_control_sensors_present & RECEIVER
        assert bool(status.onboard_control_sensors_health & RECEIVER) == is_healthy
        assert last(messages, "HEARTBEAT").system_status == state
