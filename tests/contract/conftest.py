"""Which flight controller the suite runs against, and in which state a test finds it.

``MAVBRIDGE_TEST_PEER`` names a real one; without it that is the simulator, in process on a stepped
clock and new for each test. docs/dev/contract_suite.md says what the suite does to a vehicle.
"""

import os
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, Literal, TypeVar

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from helpers.contract_peers import Companion, ExternalPeer, MockPeer, Peer
from helpers.copter_companion import CopterCompanion
from helpers.px4_companion import Px4Companion
from mavbridge.simulation.world import NOMINAL_VEHICLE
from sitl.vehicle.config import IDLE_RECEIVER_US, AutopilotName

PEER, ALLOW, RECEIVER = ("MAVBRIDGE_TEST_PEER", "MAVBRIDGE_TEST_ALLOW", "MAVBRIDGE_TEST_RECEIVER")
PERMISSIONS = ("ground", "arm", "fly")
"""Permissions of tests on a real flight controller; each includes those before it."""
COPTER_FIXTURES = ("companion", "armable", "grounded", "flying", "expendable", "without_receiver")
PX4_FIXTURES = ("px4", "px4_armable", "px4_grounded", "px4_flying", "px4_expendable")
FIRMWARES = {mav.MAV_AUTOPILOT_ARDUPILOTMEGA: COPTER_FIXTURES, mav.MAV_AUTOPILOT_PX4: PX4_FIXTURES}
FOUND_WITHIN_S = 30.0
AnyCompanion = TypeVar("AnyCompanion", CopterCompanion, Px4Companion)


class ExternalVehicle:
    """The flight controller that the environment names."""

    def __init__(self) -> None:
        address, _, baud = os.environ[PEER].partition(",")
        self.peer = ExternalPeer(address, int(baud or 115_200))
        heartbeat = Companion(self.peer).find("HEARTBEAT", FOUND_WITHIN_S)
        if heartbeat is None:
            pytest.exit(f"{PEER}={os.environ[PEER]}: no heartbeat within {FOUND_WITHIN_S:.0f} s")
        self.fixtures = FIRMWARES.get(heartbeat.autopilot, ())
        self.has_receiver = os.environ.get(RECEIVER, "idle") != "none"
        self.permission = os.environ.get(ALLOW, "ground")
        if self.permission not in PERMISSIONS:
            pytest.exit(f"{ALLOW}={self.permission}: one of {', '.join(PERMISSIONS)}")

    def runs(self, fixtures: list[str]) -> bool:
        """The tests of its firmware, and only those for its kind of receiver."""
        if "without_receiver" in fixtures:
            return not self.has_receiver and "without_receiver" in self.fixtures
        is_for_it = self.has_receiver or "px4" in self.fixtures
        return is_for_it and bool(set(fixtures) & set(self.fixtures))


EXTERNAL = pytest.StashKey[ExternalVehicle]()


def pytest_configure(config: pytest.Config) -> None:
    if PEER in os.environ:
        config.stash[EXTERNAL] = ExternalVehicle()


def pytest_unconfigure(config: pytest.Config) -> None:
    if EXTERNAL in config.stash:
        config.stash[EXTERNAL].peer.close()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """A real vehicle runs the tests of its firmware: on the ground first, then in one flight."""
    if EXTERNAL not in config.stash:
        return
    external = config.stash[EXTERNAL]
    own = [item for item in items if external.runs(_fixtures(item))]
    config.hook.pytest_deselected(items=[item for item in items if item not in own])
    items[:] = sorted(own, key=_stage)


def _fixtures(item: pytest.Item) -> list[str]:
    """Return the names of a test's fixtures, and of the vehicle that it is parametrized with."""
    params = getattr(getattr(item, "callspec", None), "params", {})
    return [*getattr(item, "fixturenames", []), str(params.get("vehicle", ""))]


def _stage(item: pytest.Item) -> int:
    names = _fixtures(item)
    kinds = ("armable", "grounded", "flying", "expendable")
    return 1 + max((n for n, kind in enumerate(kinds) if any(kind in f for f in names)), default=-1)


def _peer(request: pytest.FixtureRequest, autopilot: AutopilotName, *, receiver: bool) -> Peer:
    if EXTERNAL in request.config.stash:
        return request.config.stash[EXTERNAL].peer
    receiver_us = IDLE_RECEIVER_US if receiver else None
    return MockPeer(replace(NOMINAL_VEHICLE, autopilot=autopilot, receiver_us=receiver_us))


def _need(request: pytest.FixtureRequest, permission: str) -> None:
    external = request.config.stash.get(EXTERNAL, None)
    if external is None or PERMISSIONS.index(external.permission) >= PERMISSIONS.index(permission):
        return
    pytest.skip(f"it would {permission}: {ALLOW}={permission} allows that")


def _heard(companion: AnyCompanion) -> Iterator[AnyCompanion]:
    """A vehicle that has been heard, as the test before left it; a real one is restored."""
    companion.peer.advance(0) if companion.is_external else companion.wait("HEARTBEAT")
    yield companion
    if companion.is_external:
        companion.restore()


@pytest.fixture
def copter(request: pytest.FixtureRequest) -> Iterator[CopterCompanion]:
    """An ArduCopter; with a receiver that has idle sticks, unless the test is of none."""
    receiver = "without_receiver" not in request.fixturenames
    yield from _heard(CopterCompanion(_peer(request, "ardupilot", receiver=receiver)))


@pytest.fixture
def px4_vehicle(request: pytest.FixtureRequest) -> Iterator[Px4Companion]:
    """A PX4 without a receiver."""
    yield from _heard(Px4Companion(_peer(request, "px4", receiver=False)))


def _found(vehicle: str, permission: str, place: Literal["down", "up", "anywhere"]) -> Any:
    """A fixture: that vehicle on the ground, some metres up under neutral sticks, or as it is."""

    @pytest.fixture
    def found(request: pytest.FixtureRequest) -> Any:
        companion: Any = request.getfixturevalue(vehicle)
        _need(request, permission)
        companion.may_arm = permission != "ground"
        if place == "up":
            companion.fly_up()
        elif place == "down" and companion.is_external and companion.in_the_air:
            companion.come_down()
        return companion

    return found


companion, px4 = (_found(vehicle, "ground", "down") for vehicle in ("copter", "px4_vehicle"))
armable, px4_armable = (_found(vehicle, "arm", "down") for vehicle in ("copter", "px4_vehicle"))
grounded, px4_grounded = (_found(vehicle, "fly", "down") for vehicle in ("copter", "px4_vehicle"))
flying, px4_flying = (_found(vehicle, "fly", "up") for vehicle in ("copter", "px4_vehicle"))
expendable, px4_expendable = (_found(vehicle, "fly", "up") for vehicle in ("copter", "px4_vehicle"))
"""As those that fly, for tests that end the flight."""
without_receiver = _found("copter", "fly", "anywhere")
