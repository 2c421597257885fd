"""Flight after a release by the bridge, as measured on ArduCopter."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import last
from helpers.copter_companion import ACCEPTED, ALT_HOLD, BRAKE, LOITER, POSHOLD

UNTOUCHED = (1500, 1500, 1000, 1500)


def position(messages):
    message = last(messages, "LOCAL_POSITION_NED")
    return message.x, message.y, message.z


def test_brake_stops_and_ignores_the_sticks(flying):
    flying.hold(1.0, roll=1754)
    assert flying.set_mode(BRAKE) == ACCEPTED
    start = position(flying.hold(3.0, thr=1000))
    end = position(flying.hold(2.0, roll=1900, pitch=1200, thr=1000, yaw=1700))
    assert math.dist(start, end) < 0.5


@pytest.mark.parametrize(("mode", "sinks"), [(ALT_HOLD, True), (LOITER, True), (BRAKE, False)])
def test_sticks_given_to_an_idle_receiver_sink_in_the_pilots_modes(flying, mode, sinks):
    assert flying.set_mode(mode) == ACCEPTED
    flying.hold(1.0)
    flying.override(*[0] * 8)
    messages = flying.advance(2.0)
    assert flying.channels()[:4] == UNTOUCHED
    assert (last(messages, "LOCAL_POSITION_NED").vz > 1.5) == sinks


@pytest.mark.parametrize("mode", [LOITER, POSHOLD])
def test_position_modes_stop_at_centred_sticks(flying, mode):
    flying.hold(1.0, pitch=1300)
    assert flying.set_mode(mode) == ACCEPTED
    start = position(flying.hold(3.7))
    end = position(flying.hold(1.5))
    assert math.dist(start, end) < 0.5


def test_heartbeats_stream_at_the_requested_rate(companion):
    assert companion.stream(mav.MAVLINK_MSG_ID_HEARTBEAT, 10) == ACCEPTED
    companion.wait("HEARTBEAT")
    messages = companion.advance(2.0)
    assert sum(m.get_type() == "HEARTBEAT" for m in messages) == pytest.approx(20, abs=4)
