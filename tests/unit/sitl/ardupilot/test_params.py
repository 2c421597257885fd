"""Names, order and refusal of bad values."""

import math

import pytest

from sitl.ardupilot.params import Params


def test_names_are_sorted_and_fit_the_wire():
    params = Params()

    assert list(params.names) == sorted(params.names)
    assert all(len(name) <= 16 for name in params.names)


@pytest.mark.parametrize(
    ("name", "default"),
    [("RC_OVERRIDE_TIME", 3.0), ("RC_FS_TIMEOUT", 1.0), ("MAV_GCS_SYSID", 255.0), ("RC3_DZ", 30.0)],
)
def test_defaults_are_the_firmware_s(name, default):
    assert Params()[name] == default


def test_values_are_float32():
    params = Params()

    assert params.set("RC_OVERRIDE_TIME", 0.1)
    assert params["RC_OVERRIDE_TIME"] != 0.1
    assert params["RC_OVERRIDE_TIME"] == pytest.approx(0.1, rel=1e-7)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e300])
def test_what_is_no_float32_is_refused(value):
    params = Params()

    assert not params.set("RC_OVERRIDE_TIME", value)
    assert params["RC_OVERRIDE_TIME"] == 3.0


def test_unknown_names_are_refused():
    params = Params()

    assert not params.set("SYSID_MYGCS", 1.0)
    assert "SYSID_MYGCS" not in params.names
