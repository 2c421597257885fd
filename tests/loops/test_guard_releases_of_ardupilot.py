"""ArduPilots whose parameters have the names and units of other releases, flown the same."""

from dataclasses import replace

import pytest

from helpers.guard_flights import GuardFlight, climbing_first
from mavbridge.core.reasons import Code
from mavbridge.guard.values import Phase
from mavbridge.simulation.world import NOMINAL_VEHICLE
from sitl.vehicle.config import ArduPilotRelease


@pytest.mark.parametrize("release", ["4.6", "4.7-dev", "4.7"])
def test_a_vehicle_of_any_release_is_flown_and_its_gcs_id_is_known(
    release: ArduPilotRelease,
) -> None:
    vehicle = replace(NOMINAL_VEHICLE, ardupilot_release=release)
    flight = GuardFlight(climbing_first, arm=True, vehicle=vehicle).take_off()

    assert flight.phase is Phase.FLYING
    assert ("4.6.3" if release == "4.6" else "4.7.0") in flight.link.autopilot


@pytest.mark.parametrize("release", ["4.6", "4.7-dev", "4.7"])
def test_a_vehicle_of_any_release_that_listens_to_another_station_is_refused(
    release: ArduPilotRelease,
) -> None:
    vehicle = replace(NOMINAL_VEHICLE, ardupilot_release=release)
    flight = GuardFlight(arm=True, vehicle=vehicle, params={"MAV_GCS_SYSID": 42.0})
    flight.run(12)

    assert flight.phase is not Phase.FLYING
    assert Code.OBSTACLE in flight.codes
    assert "--set-config link.source_system=42" in str(flight.reason)
