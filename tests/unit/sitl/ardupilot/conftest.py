"""The far ends of an ArduPilot vehicle's links."""

import pytest

from helpers.ends import Ends


@pytest.fixture
def station():
    return Ends()


@pytest.fixture(scope="session")
def station_of():
    """Makes a station: ``station_of(links=2, config=VehicleConfig(...))``."""
    return Ends
