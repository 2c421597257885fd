"""The far ends of a PX4 vehicle's links; the vehicle is ready at once."""

from dataclasses import replace

import pytest

from helpers.ends import Ends
from sitl.vehicle.config import VehicleConfig

READY = VehicleConfig(
    autopilot="px4", receiver_us=None, estimator_ready_s=0.0, position_ready_s=0.0
)


@pytest.fixture
def ends():
    return Ends(config=READY)


@pytest.fixture(scope="session")
def ends_of():
    """Makes ends: ``ends_of(links=2, onboard_links=frozenset({1}))``."""
    return lambda links=1, **changes: Ends(links, replace(READY, **changes))
