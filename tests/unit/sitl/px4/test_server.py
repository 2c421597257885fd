"""PX4's links: forwarding, texts and events, hand-packed messages, receivers, termination."""

import struct

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import named
from sitl.clock import NS_PER_S
from sitl.px4.commander import Event
from sitl.px4.messages import event_message

MID = (0, 0, 500, 0)
ACCEPTED = mav.MAV_RESULT_ACCEPTED
REJECTED = mav.MAV_RESULT_TEMPORARILY_REJECTED


def test_sticks_of_one_link_arrive_on_the_other_like_an_echo(ends_of):
    ends = ends_of(links=2)

    echoes = named(ends.run(0.1, {0: (111, 0, 500, 0)}, link=1), "MANUAL_CONTROL")

    assert echoes[-1].x == 111
    assert (echoes[-1].get_srcSystem(), echoes[-1].get_srcComponent()) == (255, 190)


@pytest.mark.parametrize(
    ("target", "is_heard", "arrives"),
    [
        ((0, 0), False, True),
        ((42, 191), False, False),
        ((42, 191), True, True),
        ((1, 1), True, False),
    ],
)
def test_a_message_goes_where_its_addressee_was_heard(ends_of, target, is_heard, arrives):
    ends = ends_of(links=2)
    if is_heard:
        ping = mav.MAVLink_ping_message(0, 0, 1, 1)
        ends.send(ping, link=1, system_id=42, component_id=191)
        ends.send(ping, link=1, system_id=1, component_id=1)
    ends.send(mav.MAVLink_param_request_list_message(*target), link=0)

    assert bool(named(ends.run(0.02, link=1), "PARAM_REQUEST_LIST")) == arrives


@pytest.mark.parametrize(
    ("kind", "arrives"), [(mav.MAV_TYPE_GCS, True), (mav.MAV_TYPE_ONBOARD_CONTROLLER, False)]
)
def test_heartbeats_of_ground_stations_are_passed_on(ends_of, kind, arrives):
    ends = ends_of(links=2)
    ends.send(mav.MAVLink_heartbeat_message(kind, 8, 0, 0, 0, 3), system_id=42)

    heard = [m for m in named(ends.run(0.02, link=1), "HEARTBEAT") if m.get_srcSystem() == 42]

    assert bool(heard) == arrives


def test_an_event_has_the_number_and_layout_of_the_firmware():
    event = Event("commander_armed_by", 0x66, b"\x04", 79_300)
    sender = mav.MAVLink(None, srcSystem=1, srcComponent=1)

    frame = event_message(event, 0x53).pack(sender)

    assert event.number == 0x0190CAF3
    # As captured from PX4, trailing zeros cut.
    assert frame[10:-2].hex() == "f3ca9001c4350100530000006604"
    checksum = mav.x25crc(frame[1:-2])
    checksum.accumulate(bytes([160]))
    assert struct.unpack("<H", frame[-2:]) == (checksum.crc,)


def test_a_ground_stations_link_gets_no_imu_and_a_companions_does(ends_of):
    ends = ends_of(links=2, onboard_links=frozenset({1}))

    assert not named(ends.run(1.0, link=0), "HIGHRES_IMU")
    messages = ends.run(1.0, link=1)  # and those of the second before
    assert len(named(messages, "HIGHRES_IMU")) == pytest.approx(100, abs=2)
    assert len([m for m in named(messages, "TIMESYNC") if m.tc1 == 0]) == pytest.approx(20, abs=1)


def test_interval_zero_restores_the_default_of_the_link(ends):
    link = ends.vehicle.server.links[0]
    default_us = link.interval_us(mav.MAVLINK_MSG_ID_ATTITUDE)
    for asked_us, interval_us in ((-1, -1), (4000, 4000), (0, default_us)):
        assert link.set_interval(mav.MAVLINK_MSG_ID_ATTITUDE, asked_us)
        assert link.interval_us(mav.MAVLINK_MSG_ID_ATTITUDE) == interval_us
    assert default_us == 20_000


def test_without_a_position_its_message_goes_on(ends):
    ends.ap.position_lost = True
    messages = ends.run(1.5)

    assert named(messages, "LOCAL_POSITION_NED")
    assert not named(messages, "GLOBAL_POSITION_INT")
    assert named(messages, "ESTIMATOR_STATUS")[-1].flags == 0xE5


def test_mapped_channels_of_a_receiver_are_sticks_where_the_mode_allows(ends_of):
    ends = ends_of(receiver=True)
    ends.vehicle.set_receiver([1600, 1400, 1000, 1500])
    ends.run(0.1)
    assert not ends.ap.stick_input.valid, "MAVLink only"

    ends.vehicle.params.set("COM_RC_IN_MODE", 0)
    ends.run(0.1)

    sticks = ends.ap.stick_input.sticks
    assert sticks == pytest.approx((0.2, 0.2, -1.0, 0.0))
    assert ends.ap.sticks_us == (1600, 1400, 1000, 1500)


def test_termination_is_final(ends):
    ends.gcs_heartbeat()
    ends.run(0.2, {0: MID})
    ends.command(mav.MAV_CMD_DO_SET_MODE, 1, 2)
    assert ends.command(mav.MAV_CMD_COMPONENT_ARM_DISARM, 1) == ACCEPTED

    assert ends.command(mav.MAV_CMD_DO_FLIGHTTERMINATION, 1) == ACCEPTED
    heartbeat = named(ends.run(1.1), "HEARTBEAT")[-1]

    assert (heartbeat.custom_mode >> 16, heartbeat.system_status) == (10, 8)
    assert heartbeat.base_mode & mav.MAV_MODE_FLAG_SAFETY_ARMED
    disarm = mav.MAV_CMD_COMPONENT_ARM_DISARM
    assert ends.command(mav.MAV_CMD_DO_SET_MODE, 1, 2) == REJECTED
    assert ends.command(disarm, 0) == REJECTED
    assert ends.command(disarm, 0, 21196) == ACCEPTED
    assert ends.command(disarm, 1) == REJECTED


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [float("nan"), 0, 0, 0]])
def test_an_attitude_that_is_none_is_refused(ends, quaternion):
    ends.send(mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, quaternion, 0, 0, 0, 0.5))

    assert ends.ap.setpoint is None
    assert ends.vehicle.log.refused_messages == 1


def test_a_reboot_starts_the_clock_again_and_keeps_parameters(ends):
    ends.vehicle.params.set("COM_OBL_RC_ACT", 4)
    ends.run(2.0)
    ends.vehicle.reboot()

    messages = ends.run(0.5)

    assert named(messages, "ATTITUDE")[0].time_boot_ms < 100
    assert ends.vehicle.params["COM_OBL_RC_ACT"] == 4
    assert ends.ap.now_ns == pytest.approx(2.5 * NS_PER_S, abs=5e6)
