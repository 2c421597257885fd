"""Names, order and refusal of bad values."""

import math

import pytest

from sitl.ardupilot.params import ArduPilotParams


def test_names_are_sorted_and_fit_the_wire():
    params = ArduPilotParams()

    assert list(params.names) == sorted(params.names)
    assert all(len(name) <= 16 for name in params.names)


@pytest.mark.parametrize(
    ("name", "default"),
    [("RC_OVERRIDE_TIME", 3.0), ("RC_FS_TIMEOUT", 1.0), ("MAV_GCS_SYSID", 255.0), ("RC3_DZ", 30.0)],
)
def test_defaults_are_the_firmware_s(name, default):
    assert ArduPilotParams()[name] == default


def test_values_are_float32():
    params = ArduPilotParams()

    assert params.set("RC_OVERRIDE_TIME", 0.1)
    assert params["RC_OVERRIDE_TIME"] != 0.1
    assert params["RC_OVERRIDE_TIME"] == pytest.approx(0.1, rel=1e-7)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_what_is_no_float32_is_refused(value):
    params = ArduPilotParams()

    assert not params.set("RC_OVERRIDE_TIME", value)
    assert params["RC_OVERRIDE_TIME"] == 3.0


def test_unknown_names_are_refused():
    params = ArduPilotParams()

    assert not params.set("SYSID_MYGCS", 1.0)
    assert "SYSID_MYGCS" not in params.names


@pytest.mark.parametrize(
    ("release", "present", "absent"),
    [
        ("4.6", ("SYSID_THISMAV", "SYSID_MYGCS", "SYSID_ENFORCE", "ANGLE_MAX"), "MAV_GCS_SYSID_HI"),
        ("4.7-dev", ("MAV_SYSID", "MAV_GCS_SYSID", "MAV_OPTIONS", "PILOT_SPEED_UP"), "WP_SPD_UP"),
        ("4.7", ("MAV_SYSID", "ATC_ANGLE_MAX", "PILOT_SPD_UP", "RTL_ALT_M"), "ANGLE_MAX"),
    ],
)
def test_a_release_answers_to_its_own_names_alone(release, present, absent):
    names = ArduPilotParams(release=release).names

    assert set(present) <= set(names)
    assert absent not in names
    assert len(set(names)) == len(names) == len(ArduPilotParams().names) - (release == "4.6")


def test_release_4_7_speaks_of_metres_and_degrees():
    params = ArduPilotParams(release="4.7")

    assert params.on_wire("ATC_ANGLE_MAX") == pytest.approx(30.0)
    assert params.on_wire("PILOT_SPD_UP") == pytest.approx(2.5)
    assert params.set_on_wire("RTL_ALT_M", 20.0)
    assert params["RTL_ALT"] == pytest.approx(2000.0)
    assert not params.set_on_wire("RTL_ALT", 1500.0)
