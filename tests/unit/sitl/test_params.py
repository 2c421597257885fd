"""Parameters of both firmwares: names, order, types, units, and refusal of bad values."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.ardupilot.params import ArduPilotParams
from sitl.px4.params import Px4Params
from sitl.vehicle.config import VehicleConfig

BOTH = pytest.mark.parametrize(
    ("make", "seconds"), [(ArduPilotParams, "RC_OVERRIDE_TIME"), (Px4Params, "COM_OF_LOSS_T")]
)
"""A firmware's parameters, and one of them that is a duration."""


@BOTH
def test_values_are_float32_and_travel_as_themselves(make, seconds):
    params = make()
    assert params.set_on_wire(seconds, 0.1)
    assert params[seconds] != 0.1
    assert params[seconds] == pytest.approx(0.1, rel=1e-7)
    assert params.on_wire(seconds) == (params[seconds], mav.MAV_PARAM_TYPE_REAL32)


@BOTH
def test_unknown_names_and_values_beyond_float32_are_refused(make, seconds):
    params = make()
    before = params[seconds]
    for value in (math.nan, math.inf, -math.inf, 1e39):
        assert not params.set(seconds, value)
    assert params[seconds] == before
    assert not params.set("SYSID_MYGCS", 1.0)
    assert "SYSID_MYGCS" not in params.names


@pytest.mark.parametrize(
    ("release", "present", "absent"),
    [
        ("4.6", ("SYSID_THISMAV", "SYSID_MYGCS", "SYSID_ENFORCE", "ANGLE_MAX"), "MAV_GCS_SYSID_HI"),
        ("4.7-dev", ("MAV_SYSID", "MAV_GCS_SYSID", "MAV_OPTIONS", "ANGLE_MAX"), "SYSID_MYGCS"),
    ],
)
def test_a_release_answers_to_its_own_names_alone(release, present, absent):
    names = ArduPilotParams(VehicleConfig(ardupilot_release=release)).names
    assert set(present) <= set(names)
    assert absent not in names
    assert len(set(names)) == len(names) == len(ArduPilotParams().names) - (release == "4.6")
