"""Conditions: draws from a seed, and their effects on flight and picture."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.params import ArduPilotParams
from sitl.camera.fpv import FpvRenderer
from sitl.course import Course, Gate, make_course
from sitl.vehicle.conditions import NOMINAL, random_conditions
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.looks import held_out_conditions, training_conditions, unseen_conditions
from sitl.vehicle.rotation import from_euler

POSE = ((1.0, 0.3, -2.2), from_euler(0.1, -0.15, 0.05))

HELD_OUT = {"hidden_gates", "shaded_gates", "stray_gates", "glare"}
UNSEEN = {"haze_m", "ground_fade_m", "lens_drops"}
"""Never drawn for a demonstration."""
MAKE = {
    *("gate_back_rgb", "pip_rgb", "pip_m", "leg_rgb", "leg_m", "bar_factor", "depth_factor"),
    *("two_tone", "sky_rgb", "far_ground_rgb", "ridge_rgb", "ground_rgb", "field_m", "grid_rgb"),
    *("grid_m", "clutter"),
}
"""Drawn for demonstrations, but not by ``random_conditions``."""
NOMINAL_POSITION = (-0.661369108, -8.008113679, -3.14245931)
NOMINAL_ATTITUDE = (0.995199671, 0.097863692, -0.00053679, -0.000157648)
NOMINAL_FORCE_MPS2 = (-0.422129501, 0.070705367, -10.009848311)
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
    ap = ArduCopter(ArduPilotParams(config), config, boot_ns=0)
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
    assert truth.specific_force_body_mps2 == pytest.approx(NOMINAL_FORCE_MPS2, abs=1e-7)


def test_the_nominal_view_has_not_changed():
    """Means of 16 pixel squares; a level of slack for other builds of OpenCV."""
    blocks = render(NOMINAL).reshape(4, 16, 4, 16, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(blocks.sum(axis=2), NOMINAL_VIEW, atol=1.0)


def test_every_field_is_drawn_and_the_seed_decides():
    drawn = random_conditions(8)
    assert drawn == random_conditions(8)
    same = {f.name for f in fields(drawn) if getattr(drawn, f.name) == getattr(NOMINAL, f.name)}
    assert same == HELD_OUT | UNSEEN | MAKE


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


def test_a_training_look_changes_anything_but_what_is_held_out():
    """Its darkest sky is brighter than the brightest night. One in three is as drawn at random."""
    looks = [training_conditions(seed) for seed in range(300)]
    plain = [look for look in looks if look == random_conditions(look.seed)]
    assert 60 < len(plain) < 140
    changed = set()
    for look in looks:
        usual = random_conditions(look.seed)
        changed |= {f.name for f in fields(look) if getattr(look, f.name) != getattr(usual, f.name)}
        assert all(getattr(look, name) == getattr(NOMINAL, name) for name in HELD_OUT | UNSEEN)
        assert look.ground_contrast == usual.ground_contrast
        assert sky_level(look) > 60
    assert changed == MAKE | {"gate_rgb", "ground_tint", "sun_ned", "ambient", "exposure"}
    nights = [held_out_conditions(seed) for seed in range(2, 300, 5)]
    assert max(sky_level(replace(night, exposure=1.0)) for night in nights) < 45


def sky_level(look):
    """Mean level of the sky, 0..255."""
    return look.exposure * (np.mean(look.sky_rgb, axis=0) * look.sky_tint).mean()


def test_an_unseen_look_is_fog_or_a_dirty_lens():
    for seed in range(8):
        usual, unseen = random_conditions(seed), unseen_conditions(seed)
        assert unseen.wind_ned_mps == usual.wind_ned_mps
        assert (unseen.lens_drops > 0) == bool(seed % 2) == (unseen.haze_m == usual.haze_m)


def test_fog_hides_all_that_is_far():
    """A gate 30 m away and the ground before it look like the sky; the near ground does not."""
    fog = replace(unseen_conditions(4), image_noise=0.0, camera_roll_rad=0.0)
    gate = Gate(center_ned_m=(30.0, 0.0, -2.0), yaw_rad=0.0, size_m=2.4, index=0)
    image = FpvRenderer(Course(seed=0, gates=(gate,)), 64, 64, fog).render(
        (0.0, 0.0, -2.0), from_euler(0.0, -fog.camera_tilt_rad, 0.0)
    )
    assert np.ptp(image[:34], axis=(0, 1)).max() < 12
    assert np.ptp(image[50:], axis=(0, 1)).max() > 20


@pytest.mark.parametrize("name", ["hidden_gates", "shaded_gates", "stray_gates", "glare"])
def test_conditions_that_hide_gates_change_the_picture(name):
    """A sun straight ahead, for the glare."""
    usual = replace(NOMINAL, sun_ned=(1.0, 0.0, -0.2), seed=2)
    changed = render(replace(usual, **{name: 1.0})).astype(int)
    assert np.abs(changed - render(usual)).mean() > 0.5


def test_the_wind_carries_a_level_vehicle_along():
    windy = fly(replace(NOMINAL, wind_ned_mps=(0.0, 3.0, 0.0)))
    still = fly(NOMINAL)
    assert windy.truth.position_ned_m[1] > still.truth.position_ned_m[1] + 1.0


def test_gusts_and_noise_come_from_the_seed():
    rough = replace(NOMINAL, gust_rms_mps=1.0, velocity_noise_mps=0.1)
    first, again, other = (fly(replace(rough, seed=seed), 4.0) for seed in (1, 1, 2))
    assert first.truth == again.truth != other.truth
    assert first.sensed.velocity_ned_mps != first.truth.velocity_ned_mps
    assert first.sensed.position_ned_m == first.truth.position_ned_m
