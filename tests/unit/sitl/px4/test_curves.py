"""PX4's stick curves, at the points that were measured on the firmware."""

import math

import pytest

from sitl.px4 import sticks as curves
from sitl.px4.params import Px4Params
from sitl.px4.sticks import from_manual_control


def sticks(x=0, y=0, z=500, r=0):
    return from_manual_control(x, y, z, r)


@pytest.mark.parametrize(
    ("z", "climb_mps"), [(500, 0.0), (550, 0.0), (600, 0.15), (750, 0.7), (1000, 3.0), (0, -1.5)]
)
def test_climb(z, climb_mps):
    assert curves.climb_mps(sticks(z=z), Px4Params()) == pytest.approx(climb_mps, abs=0.02)


def test_both_sticks_share_the_lean():
    accel = curves.lean_accel_mps2(sticks(x=1000, y=1000), Px4Params())
    assert math.degrees(math.atan(math.hypot(*accel) / 9.80665)) == pytest.approx(35.0)
    assert math.degrees(math.hypot(*curves.lean_rad(sticks(x=1000, y=1000), Px4Params()))) == (
        pytest.approx(35.0)
    )


def test_stab_leans_by_the_angle_and_hovers_at_mid_stick():
    roll, pitch = curves.lean_rad(sticks(x=500, y=500), Px4Params())

    assert math.degrees(roll) == pytest.approx(17.5)
    assert math.degrees(pitch) == pytest.approx(-17.5)
    assert curves.manual_thrust(sticks(), Px4Params(), 0.484) == pytest.approx(0.484)
    assert curves.manual_thrust(sticks(z=1000), Px4Params(), 0.484) == pytest.approx(1.0)


def test_acro_is_linear():
    rates = curves.acro_rates_radps(sticks(x=300, y=300, r=-300), Px4Params())
    assert [math.degrees(rate) for rate in rates] == pytest.approx([30.0, -30.0, -30.0])
