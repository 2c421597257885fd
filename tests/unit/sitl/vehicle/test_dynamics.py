"""The rigid body against hand-computed physics, and the one conversion between frames."""

import math

import pytest

from sitl.vehicle.dynamics import GRAVITY_MPS2, QUAD, Quadrotor

STEPS_PER_S = 1_000_000_000 // QUAD.step_ns


def fly(commands, seconds, quad=None):
    quad = quad or Quadrotor()
    quad.step(commands, round(seconds * STEPS_PER_S))
    return quad.body


def test_it_rests_on_the_ground_and_feels_one_g_upwards():
    body = fly((0.0,) * 4, 1.0)
    assert body.touching
    assert body.position_ned_m == pytest.approx((0.0, 0.0, 0.0), abs=1e-3)
    assert body.specific_force_body_mps2 == pytest.approx((0.0, 0.0, -GRAVITY_MPS2), abs=0.01)


def test_motors_follow_with_a_first_order_lag():
    body = fly((1.0,) * 4, QUAD.motor_lag_s)
    thrust_n = -QUAD.mass_kg * body.specific_force_body_mps2[2]
    reached = thrust_n / (4.0 * QUAD.max_motor_thrust_n)
    assert reached == pytest.approx(1.0 - math.exp(-1.0), rel=0.04)


@pytest.mark.parametrize(
    ("commands", "axis", "sign"),
    [
        ((0.4, 0.5, 0.5, 0.4), 0, 1.0),  # more thrust left: rolls right
        ((0.5, 0.4, 0.5, 0.4), 1, 1.0),  # more thrust in front: nose up
        ((0.5, 0.5, 0.4, 0.4), 2, 1.0),  # more on the anticlockwise pair: nose right
        ((0.5, 0.4, 0.4, 0.5), 0, -1.0),
    ],
)
def test_motor_order_and_signs(commands, axis, sign):
    quad = Quadrotor()
    fly((0.5,) * 4, 1.0, quad=quad)
    rates = fly(commands, 0.1, quad=quad).rate_body_radps
    assert sign * rates[axis] > 0.05
    assert all(abs(rate) < 1e-3 for other, rate in enumerate(rates) if other != axis)
