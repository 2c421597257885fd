"""Peers of the contract suite: the simulator in process on a stepped clock, or a real one by UDP.

``MAVBRIDGE_TEST_PEER=udp:HOST:PORT`` (a port of ours that the peer sends to) puts that ArduCopter
through the same suite, in real time; ``MAVBRIDGE_TEST_PX4_PEER`` does the same for a PX4.
"""

import os
from collections.abc import Iterator
from contextlib import closing

import pytest

from helpers.contract_peers import Companion, MockPeer, UdpPeer
from helpers.px4_companion import Px4Companion
from sitl.vehicle.config import VehicleConfig

PEER_VARIABLE, PX4_PEER_VARIABLE = "MAVBRIDGE_TEST_PEER", "MAVBRIDGE_TEST_PX4_PEER"


def peer_by_udp(variable: str) -> UdpPeer:
    """The flight controller that the environment names; skips without one."""
    url = os.environ.get(variable)
    if url is None:
        pytest.skip(f"{variable} names no flight controller")
    _, host, port = url.split(":")
    return UdpPeer((host, int(port)))


@pytest.fixture(params=["mock", *(["external"] if PEER_VARIABLE in os.environ else [])])
def companion(request: pytest.FixtureRequest) -> Iterator[Companion]:
    """A companion that has heard the vehicle; the vehicle has a receiver with idle sticks."""
    if request.param == "mock":
        companion = Companion(MockPeer(VehicleConfig()))
        companion.wait("HEARTBEAT")
        yield companion
        return
    with closing(peer_by_udp(PEER_VARIABLE)) as peer:
        companion = Companion(peer)
        companion.wait("HEARTBEAT", timeout_s=30.0)
        yield companion
        companion.restore()


@pytest.fixture
def external_companion() -> Iterator[Companion]:
    """A companion of the external peer; skips without one."""
    with closing(peer_by_udp(PEER_VARIABLE)) as peer:
        yield Companion(peer)


@pytest.fixture
def companion_without_receiver() -> Companion:
    """As ``companion``, but the vehicle never had a receiver (an external one cannot lose its)."""
    companion = Companion(MockPeer(VehicleConfig(receiver=False)))
    companion.wait("HEARTBEAT")
    return companion


@pytest.fixture(params=["mock", *(["external"] if PX4_PEER_VARIABLE in os.environ else [])])
def px4(request: pytest.FixtureRequest) -> Iterator[Px4Companion]:
    """A ground station of a PX4 without a receiver, on the ground."""
    if request.param == "mock":
        companion = Px4Companion(MockPeer(VehicleConfig(autopilot="px4", receiver=False)))
        companion.wait("HEARTBEAT")
        yield companion
        return
    with closing(peer_by_udp(PX4_PEER_VARIABLE)) as peer:
        companion = Px4Companion(peer)
        companion.wait("HEARTBEAT", timeout_s=30.0)
        yield companion
        companion.restore()
