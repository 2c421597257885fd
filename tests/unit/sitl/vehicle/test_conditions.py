"""Conditions: draws from a seed, and their effects on flight and picture."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from sitl import UsageError
from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.params import ArduPilotParams
from sitl.camera.fpv import FpvRenderer
from sitl.course import make_course
from sitl.vehicle.conditions import NOMINAL, held_out_conditions, random_conditions
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.rotation import from_euler

POSE = ((1.0, 0.3, -2.2), from_euler(0.1, -0.15, 0.05))

HELD_OUT = {"hidden_gates", "shaded_gates", "stray_gates", "glare"}
"""Never drawn for a demonstration."""
NOMINAL_POSITION = (-0.661369108, -8.008113679, -3.14245931)
NOMINAL_ATTITUDE = (0.995199671, 0.097863692, -0.00053679, -0.000157648)
NOMINAL_VIEW = [
    [385.2, 398.4, 413.0, 428.3],
    [545.5, 506.4, 507.1, 533.1],
    [399.5, 352.6, 318.3, 332.0],
    [275.9, 267.7, 284.3, 279.9],
]
"""Sums over the colours."""


def fly(conditions, seconds=8.0):
    """Take off, then weave; the state at the end."""
    config = VehicleConfig(estimator_ready_s=0.0, conditions=conditions)
    ap = ArduCopter(ArduPilotParams(conditions), config, boot_ns=0)
    for tick in range(round(seconds * 100)):
        t_s = tick / 100
        sticks = [1500, 1500, 1000 if t_s < 0.5 else 1800 if t_s < 3.0 else 1500, 1500]
        if t_s > 3.0:
            sticks[0] = 1500 + round(200 * math.sin(t_s))
            sticks[1] = 1500 - round(250 * math.cos(t_s))
        ap.rc.override([*sticks, *[65535] * 4], ap.now_ns)
        if tick == 20:
            assert ap.set_mode(Mode.ALT_HOLD)
            assert ap.arm(force=False), ap.texts
        for _ in range(4):
            ap.step()
    return ap


def render(conditions, size_px=64):
    return FpvRenderer(make_course(7), size_px, size_px, conditions).render(*POSE)


def test_the_nominal_flight_has_not_changed():
    truth = fly(NOMINAL).truth
    assert truth.position_ned_m == pytest.approx(NOMINAL_POSITION, abs=1e-7)
    assert truth.ned_from_body_wxyz == pytest.approx(NOMINAL_ATTITUDE, abs=1e-7)


def test_the_nominal_view_has_not_changed():
    """Means of 16 pixel squares; a level of slack for other builds of OpenCV."""
    blocks = render(NOMINAL).reshape(4, 16, 4, 16, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(blocks.sum(axis=2), NOMINAL_VIEW, atol=1.0)


def test_every_field_is_drawn_and_the_seed_decides():
    drawn = random_conditions(8)
    assert drawn == random_conditions(8)
    same = {f.name for f in fields(drawn) if getattr(drawn, f.name) == getattr(NOMINAL, f.name)}
    assert same == HELD_OUT


def test_a_held_out_look_is_one_that_no_demonstration_has():
    """Night is in the tints: darker than the darkest that is drawn else. One seed in five each."""
    changed = dict.fromkeys(HELD_OUT, 0)
    darkest = min(min(random_conditions(seed).sky_tint) for seed in range(200))
    nights = 0
    for seed in range(40):
        usual, held_out = random_conditions(seed), held_out_conditions(seed)
        assert held_out.wind_ned_mps == usual.wind_ned_mps
        for name in HELD_OUT:
            changed[name] += getattr(held_out, name) != getattr(NOMINAL, name)
        nights += max(held_out.sky_tint) < darkest / 2
    assert nights == 8
    assert set(changed.values()) == {8}


@pytest.mark.parametrize("name", ["hidden_gates", "shaded_gates", "stray_gates", "glare"])
def test_conditions_that_hide_gates_change_the_picture(name):
    """A sun straight ahead, for the glare."""
    usual = replace(NOMINAL, sun_ned=(1.0, 0.0, -0.2), seed=2)
    changed = render(replace(usual, **{name: 1.0})).astype(int)
    assert np.abs(changed - render(usual)).mean() > 0.5


def test_a_negative_seed_is_refused():
    with pytest.raises(UsageError):
        random_conditions(-1)


def test_the_wind_carries_a_level_vehicle_along():
    windy = fly(replace(NOMINAL, wind_ned_mps=(0.0, 3.0, 0.0)))
    still = fly(NOMINAL)
    assert windy.truth.position_ned_m[1] > still.truth.position_ned_m[1] + 1.0


def test_a_smaller_gain_of_the_rate_loop_takes_longer_to_roll():
    rates = []
    for factor in (1.0, 0.7):
        ap = fly(replace(NOMINAL, rate_gain_factor=factor), 3.0)
        ap.rc.override([1700, *[65535] * 7], ap.now_ns)
        for _ in range(40):
            ap.step()
        rates.append(ap.truth.rate_body_radps[0])
    assert rates[0] > 1.05 * rates[1] > 0


def test_gusts_and_noise_come_from_the_seed():
    rough = replace(NOMINAL, gust_rms_mps=1.0, velocity_noise_mps=0.1)
    first, again, other = (fly(replace(rough, seed=seed), 4.0) for seed in (1, 1, 2))
    assert first.truth == again.truth != other.truth
    assert first.sensed.velocity_ned_mps != first.truth.velocity_ned_mps
    assert first.sensed.position_ned_m == first.truth.position_ned_m
