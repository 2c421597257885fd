"""PX4's parameters: two types, and what they look like on the wire."""

import struct

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mav

from sitl.px4.params import Px4Params
from sitl.vehicle.conditions import random_conditions


def as_float(value):
    return struct.unpack("<f", struct.pack("<i", value))[0]


def test_an_integer_travels_as_its_bytes():
    params = Px4Params()

    assert params.kind("NAV_RCL_ACT") == mav.MAV_PARAM_TYPE_INT32
    assert params.on_wire("NAV_RCL_ACT") == as_float(2)
    assert params.set_on_wire("NAV_RCL_ACT", as_float(3))
    assert params.integer("NAV_RCL_ACT") == 3


def test_a_float_travels_as_itself():
    params = Px4Params()

    assert params.kind("COM_OF_LOSS_T") == mav.MAV_PARAM_TYPE_REAL32
    assert params.set_on_wire("COM_OF_LOSS_T", 0.3)
    assert params.on_wire("COM_OF_LOSS_T") == pytest.approx(0.3)


@pytest.mark.parametrize(
    ("name", "value"),
    [("NO_SUCH", 1.0), ("COM_OF_LOSS_T", float("nan")), ("COM_OF_LOSS_T", 1e39),
     ("NAV_RCL_ACT", 2.0**31)],
)  # fmt: skip
def test_what_does_not_fit_is_refused(name, value):
    assert not Px4Params().set(name, value)


def test_names_are_sorted_and_fit_the_wire():
    names = Px4Params().names

    assert list(names) == sorted(names)
    assert all(len(name) <= 16 for name in names)


def test_a_receiver_is_mapped():
    assert Px4Params()["RC_MAP_THROTTLE"] == 0
    assert Px4Params(receiver=True)["RC_MAP_THROTTLE"] == 3


def test_other_vehicles_have_other_settings():
    nominal, drawn = Px4Params(), Px4Params(random_conditions(8))
    varied = {name for name in nominal.names if drawn[name] != nominal[name]}

    assert varied >= {"MPC_MAN_TILT_MAX", "MPC_MAN_Y_MAX", "MPC_Z_VEL_MAX_DN", "MC_ROLLRATE_P"}
    assert 35.0 <= drawn["MPC_MAN_TILT_MAX"] <= 52.5
    assert 1.07 <= drawn["MPC_Z_VEL_MAX_DN"] <= 2.1
