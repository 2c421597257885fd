"""The listener is fed with real MAVLink bytes of a made-up vehicle; time is given."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from helpers.wire import WireEnd
from sitl.camera.follow import PoseListener
from sitl.clock import NS_PER_S
from sitl.vehicle.rotation import IDENTITY, from_euler

T0_NS = 100 * NS_PER_S
RATE_HZ = 60.0
QUATERNION, POSITION = 31, 32


class Vehicle(WireEnd):
    def quaternion(self, wxyz=IDENTITY, rate_radps=(0.0, 0.0, 0.0)):
        return self.pack(self.mav.attitude_quaternion_encode(0, *wxyz, *rate_radps))

    def position(self, position_m=(1.0, 2.0, -3.0), velocity_mps=(0.0, 0.0, 0.0)):
        return self.pack(self.mav.local_position_ned_encode(0, *position_m, *velocity_mps))


@pytest.fixture
def vehicle():
    return Vehicle()


@pytest.fixture
def listener(vehicle):
    listener = PoseListener(rate_hz=RATE_HZ)
    listener.receive(vehicle.heartbeat(), T0_NS)
    return listener


def decode(packets):
    """Read with a parser that knows nothing of the sender."""
    return mavlink.MAVLink(None).parse_buffer(b"".join(packets)) or []


def requested(packets):
    return [int(m.param1) for m in decode(packets) if m.get_type() == "COMMAND_LONG"]


def test_the_pose_is_carried_on_at_constant_velocity_and_rate(listener, vehicle):
    turning = vehicle.quaternion(from_euler(0.0, 0.0, 1.0), (0.0, 0.0, 2.0))
    listener.receive(turning, T0_NS)
    listener.receive(vehicle.position((1.0, 2.0, -3.0), (4.0, -8.0, 1.0)), T0_NS + NS_PER_S // 4)
    position_m, wxyz = listener.pose_at(T0_NS + NS_PER_S // 2)
    assert position_m == pytest.approx((2.0, 0.0, -2.75))
    assert wxyz == pytest.approx(from_euler(0.0, 0.0, 2.0), abs=1e-6)


@pytest.mark.parametrize(
    "bad",
    [
        pytest.param(lambda v: v.position((math.nan, 0.0, 0.0)), id="position NaN"),
        pytest.param(lambda v: v.position(velocity_mps=(0, math.inf, 0)), id="velocity inf"),
        pytest.param(lambda v: v.quaternion((0.0, 0.0, 0.0, 0.0)), id="zero quaternion"),
        pytest.param(lambda v: v.quaternion((math.nan, 0.0, 0.0, 0.0)), id="quaternion NaN"),
        pytest.param(lambda v: v.quaternion(rate_radps=(math.nan, 0, 0)), id="rate NaN"),
    ],
)
def test_values_that_cannot_be_are_ignored(listener, vehicle, bad):
    listener.receive(vehicle.quaternion() + vehicle.position(), T0_NS)
    before = listener.pose_at(T0_NS)
    listener.receive(bad(vehicle), T0_NS)
    assert listener.pose_at(T0_NS) == before


def test_only_the_first_autopilot_is_followed():
    listener, camera, other = PoseListener(rate_hz=RATE_HZ), Vehicle(1, 100), Vehicle(2)
    listener.receive(Vehicle(255, 190).heartbeat(autopilot=mavlink.MAV_AUTOPILOT_INVALID), T0_NS)
    listener.receive(Vehicle(7, 1).heartbeat(autopilot=mavlink.MAV_AUTOPILOT_INVALID), T0_NS)
    listener.receive(Vehicle(1).heartbeat() + other.heartbeat(), T0_NS)
    listener.receive(other.quaternion() + other.position(), T0_NS)
    listener.receive(camera.quaternion() + camera.position(), T0_NS)
    assert listener.pose_at(T0_NS) is None
    assert {m.target_system for m in decode(listener.outgoing(T0_NS))[1:]} == {1}


def run_second(listener, second, packets):
    """A second of these packets; returns what is asked for at its end."""
    for packet in packets:
        listener.receive(packet, T0_NS + second * NS_PER_S - 1)
    return requested(listener.outgoing(T0_NS + second * NS_PER_S))


def test_a_message_is_requested_until_it_streams_and_again_when_its_rate_drops(listener, vehicle):
    flows = [vehicle.quaternion(), vehicle.position()] * 60
    assert requested(listener.outgoing(T0_NS)) == [QUATERNION, POSITION]
    assert run_second(listener, 1, []) == [QUATERNION, POSITION]
    assert run_second(listener, 2, flows) == []
    assert run_second(listener, 3, [vehicle.quaternion()] * 60 + [vehicle.position()] * 4) == [
        POSITION
    ]
    assert run_second(listener, 4, flows) == []
