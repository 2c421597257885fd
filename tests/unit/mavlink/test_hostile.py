"""Faults that hostile datagrams have found: what one sender says must not last, grow or fly."""

import math
import time

import pytest

from helpers.fakes import START_NS
from helpers.flown_vehicle import Flight, FlownVehicle, codec
from helpers.parameters import ParamVehicle
from helpers.wire import WireEnd
from mavbridge.core.clock import NS_PER_MS, NS_PER_S
from mavbridge.core.vehicle import ActionMeaning, Velocity
from mavbridge.mavlink.codec.messages import ParamValue
from mavbridge.mavlink.codec.packets import MOST_DATAGRAM_BYTES
from mavbridge.mavlink.outputs.echo import EchoCheck
from mavbridge.mavlink.outputs.setpoints import VelocityOutput
from mavbridge.mavlink.outputs.sticks import OVERRIDE_ECHO
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.session.stats import LinkCounters
from mavbridge.mavlink.session.timesync import TimesyncFilter

MS, S = NS_PER_MS, NS_PER_S
OURS, PILOTS = (1600, 1550, 1500, 1700), (1500, 1500, 1500, 1500)


@pytest.mark.parametrize("unit", [b"\xfe\0", b"\xfd\0\0\0\0\0"], ids=["v1", "v2"])
def test_a_huge_datagram_costs_no_more_than_a_large_one(unit: bytes) -> None:
    """All of it would have kept the guard from its sticks for 35 ms."""
    ours = codec()
    huge = (unit * 65_507)[:65_507]
    start_s = time.thread_time()
    assert list(ours.decode_datagram(huge)) == []
    assert time.thread_time() - start_s < 0.05
    assert ours.bad_data_count <= 1 + MOST_DATAGRAM_BYTES // 8
    assert [m.name for m in ours.decode_datagram(WireEnd().heartbeat())] == ["HEARTBEAT"]


def test_a_stamp_from_the_far_future_does_not_blind_the_echo_check() -> None:
    """All that came after it was left out as late, and no flight could begin any more."""
    echo = EchoCheck(OVERRIDE_ECHO)
    echo.received(PILOTS, 4_294_967_295_000, S)
    for k in range(100):
        now_ns = S + k * 20 * MS
        echo.sent((*OURS[:3], OURS[3] - 4 * (k % 3)), now_ns)
        echo.received((*OURS[:3], OURS[3] - 4 * (k % 3)), 70_000_000 + k * 20_000, now_ns)
    assert echo.confirmed
    assert echo.fault(now_ns) is None


def test_names_that_nobody_needs_are_not_collected() -> None:
    vehicle = ParamVehicle()
    vehicle.run(2.0)
    known = len(vehicle.params._kinds)
    for k in range(5000):
        vehicle.params.receive(ParamValue(name=f"X{k}", value=1.0), None)
    assert len(vehicle.params._kinds) == known


def test_advice_about_values_that_keep_changing_ends() -> None:
    vehicle = ParamVehicle()
    vehicle.run(8.0)
    for k in range(1000):
        vehicle.has_receiver = k % 2 == 0  # so that it is judged anew
        vehicle.set_by_pilot("RC_OVERRIDE_TIME", 2.0 + k)
        vehicle.run(0.01)
    assert 50 < len(vehicle.texts) <= 110


def test_messages_without_a_name_are_counted_together() -> None:
    counters = LinkCounters()
    for k in range(5000):
        counters.receive(f"UNKNOWN_{k}", k % 256, START_NS + k * MS)
    stats = counters.stats(TimesyncFilter(), echo_confirmed=None, unusable_packets=0, saturated={})
    assert len(stats.messages_per_s) == 501
    assert dict(stats.messages_per_s)["others"] > 0


@pytest.mark.parametrize("limit", [-20.0, -3.4e38])
def test_a_climb_rate_that_cannot_be_turns_no_climb_into_a_descent(limit: float) -> None:
    vehicle = FlownVehicle(PX4)
    vehicle.known_params = {"MPC_Z_VEL_MAX_UP": limit, "MPC_Z_VEL_MAX_DN": limit}
    flight = Flight(VelocityOutput(codec(), ActionMeaning(kind="velocity")), vehicle)
    for down_mps in (-2.0, 0.0, 2.0):
        message = flight.message(flight.send(Velocity(0.0, 0.0, down_mps, 0.0)))
        assert math.isclose(message.vz, 0.0, abs_tol=0.01)
