"""Other conditions change what they should; none at all change nothing."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from sitl import UsageError
from sitl.ardupilot.autopilot import ArduCopter
from sitl.ardupilot.flight_modes import Mode
from sitl.ardupilot.params import ArduPilotParams
from sitl.camera.fpv import FpvRenderer
from sitl.camera.scenery import STRAY_CLEARANCE_M, course_faces
from sitl.course import make_course
from sitl.rotation import from_euler, multiply
from sitl.vehicle.conditions import NOMINAL, Conditions, held_out_conditions, random_conditions
from sitl.vehicle.config import VehicleConfig
from sitl.vehicle.dynamics import GRAVITY_MPS2, Quadrotor

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


def test_the_nominal_flight_is_what_it_was_before_there_were_conditions():
    truth = fly(NOMINAL).truth
    assert truth.position_ned_m == pytest.approx(NOMINAL_POSITION, abs=1e-7)
    assert truth.ned_from_body_wxyz == pytest.approx(NOMINAL_ATTITUDE, abs=1e-7)


def test_the_nominal_view_is_what_it_was_before_there_were_conditions():
    """Means of 16 pixel squares; a level of slack for other builds of OpenCV."""
    blocks = render(NOMINAL).reshape(4, 16, 4, 16, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(blocks.sum(axis=2), NOMINAL_VIEW, atol=1.0)


def test_a_strength_of_zero_is_nominal():
    assert replace(random_conditions(9, strength=0.0), seed=0) == NOMINAL == Conditions()


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
def test_what_hides_gates_changes_the_picture(name):
    """A sun straight ahead, for the glare."""
    usual = replace(NOMINAL, sun_ned=(1.0, 0.0, -0.2), seed=2)
    changed = render(replace(usual, **{name: 1.0})).astype(int)
    assert np.abs(changed - render(usual)).mean() > 0.5


def test_the_sun_behind_does_not_blind():
    behind = replace(NOMINAL, sun_ned=(-0.9, 0.0, -0.4))
    np.testing.assert_array_equal(render(replace(behind, glare=1.0)), render(behind))


def test_numbers_are_flat():
    numbers = random_conditions(4).numbers()
    assert numbers["wind_ned_mps_0"] == random_conditions(4).wind_ned_mps[0]
    assert numbers["gate_rgb_1_2"] == random_conditions(4).gate_rgb[1][2]
    assert all(type(value) is float for value in numbers.values())


@pytest.mark.parametrize(("seed", "strength"), [(-1, 1.0), (1, -0.1), (1, math.nan)])
def test_what_makes_no_sense_is_refused(seed, strength):
    with pytest.raises(UsageError):
        random_conditions(seed, strength)


def test_half_the_mass_falls_as_fast_and_climbs_faster():
    nominal, light = Quadrotor(), Quadrotor(replace(NOMINAL, mass_factor=0.5))
    climb = [
        -quad.step(quad.at_rest(), (0.6,) * 4, 400).body.velocity_ned_mps[2]
        for quad in (nominal, light)
    ]
    assert climb[1] > 2 * climb[0] > 0
    start = ((0.0, 0.0, -50.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    drop = [
        quad.step(quad.airborne(*start), (0.0,) * 4, 80).body.velocity_ned_mps[2]
        for quad in (nominal, light)
    ]
    assert drop[0] == pytest.approx(drop[1], rel=0.4)
    assert drop[0] < 0.1 * GRAVITY_MPS2


def test_the_wind_carries_a_level_vehicle_along():
    windy = fly(replace(NOMINAL, wind_ned_mps=(0.0, 3.0, 0.0)))
    still = fly(NOMINAL)
    assert windy.truth.position_ned_m[1] > still.truth.position_ned_m[1] + 1.0


@pytest.mark.parametrize(("nspm", "is_heavier"), [(0.1, False), (0.8, True)])
def test_an_airframe_keeps_the_drag_it_has(nspm, is_heavier):
    """Of 10 m/s are left after a second: exp(-nspm / 1.2 kg) at most."""
    start = ((0.0, 0.0, -50.0), (10.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    nominal_mps, mps = (
        quad.step(quad.airborne(*start), (0.39,) * 4, 800).body.velocity_ned_mps[0]
        for quad in (Quadrotor(), Quadrotor(replace(NOMINAL, min_rotor_drag_nspm=nspm)))
    )
    assert (mps < nominal_mps) == is_heavier
    assert mps == nominal_mps or mps < 10.0 * math.exp(-nspm / 1.2)


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


def test_exposure_makes_it_brighter_and_blur_softer():
    nominal = render(NOMINAL).astype(int)
    assert render(replace(NOMINAL, exposure=1.3)).mean() > 1.1 * nominal.mean()
    soft = render(replace(NOMINAL, blur_px=6.0)).astype(int)
    assert np.abs(np.diff(soft, axis=1)).mean() < 0.8 * np.abs(np.diff(nominal, axis=1)).mean()


def test_a_rolled_and_turned_camera_sees_what_a_rolled_and_turned_vehicle_does():
    """With the optical axis along the nose."""
    position, attitude = POSE
    level = replace(NOMINAL, camera_tilt_rad=0.0)
    course = make_course(7)
    turned = replace(level, camera_roll_rad=0.1, camera_yaw_rad=-0.2)
    seen = FpvRenderer(course, 64, 64, turned).render(position, attitude)
    same = multiply(attitude, from_euler(0.1, 0.0, -0.2))
    wanted = FpvRenderer(course, 64, 64, level).render(position, same)
    assert np.abs(seen.astype(int) - wanted).mean() < 0.1


def test_gates_out_of_order_stand_clear_of_those_of_the_course():
    course = make_course(7)
    own = course_faces(course)
    faces = course_faces(course, replace(NOMINAL, stray_gates=1.0, seed=3))
    strays_m = faces.centers_ned_m[len(course.gates) :]
    assert 4 <= len(strays_m) <= len(course.gates)
    np.testing.assert_array_equal(faces.corners_ned_m[: len(own.corners_ned_m)], own.corners_ned_m)
    between = strays_m[:, None, :2] - own.centers_ned_m[None, :, :2]
    assert np.linalg.norm(between, axis=2).min() >= STRAY_CLEARANCE_M
