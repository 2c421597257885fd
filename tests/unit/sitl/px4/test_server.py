"""PX4's links: forwarding, texts and events, hand-packed messages."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import named
from helpers.ends import px4_ends


def test_sticks_of_one_link_arrive_on_the_other_like_an_echo():
    ends = px4_ends(links=2)
    echoes = named(ends.run(0.1, {0: (111, 0, 500, 0)}, link=1), "MANUAL_CONTROL")
    assert echoes[-1].x == 111
    assert (echoes[-1].get_srcSystem(), echoes[-1].get_srcComponent()) == (255, 190)


@pytest.mark.parametrize(
    ("target", "arrives"), [((0, 0), True), ((42, 191), True), ((1, 1), False)]
)
def test_a_message_that_is_not_for_the_vehicle_alone_is_passed_on(target, arrives):
    ends = px4_ends(links=2)
    ends.send(mav.MAVLink_param_request_list_message(*target), link=0)
    assert bool(named(ends.run(0.02, link=1), "PARAM_REQUEST_LIST")) == arrives


@pytest.mark.parametrize(
    ("kind", "arrives"), [(mav.MAV_TYPE_GCS, True), (mav.MAV_TYPE_ONBOARD_CONTROLLER, False)]
)
def test_heartbeats_of_ground_stations_are_passed_on(kind, arrives):
    ends = px4_ends(links=2)
    ends.send(mav.MAVLink_heartbeat_message(kind, 8, 0, 0, 0, 3), system_id=42)
    heard = [m for m in named(ends.run(0.02, link=1), "HEARTBEAT") if m.get_srcSystem() == 42]
    assert bool(heard) == arrives


def test_a_ground_stations_link_gets_no_imu_and_a_companions_does():
    ends = px4_ends(links=2, onboard_links=frozenset({1}))
    assert not named(ends.run(1.0, link=0), "HIGHRES_IMU")
    messages = ends.run(1.0, link=1)  # and those of the second before
    assert len(named(messages, "HIGHRES_IMU")) == pytest.approx(100, abs=2)
    assert len([m for m in named(messages, "TIMESYNC") if m.tc1 == 0]) == pytest.approx(20, abs=1)


@pytest.mark.parametrize("quaternion", [[0, 0, 0, 0], [float("nan"), 0, 0, 0]])
def test_an_attitude_that_is_none_is_refused(ends, quaternion):
    ends.send(mav.MAVLink_set_attitude_target_message(0, 1, 1, 7, quaternion, 0, 0, 0, 0.5))
    assert ends.ap.setpoint is None
    assert ends.vehicle.log.refused_messages == 1
