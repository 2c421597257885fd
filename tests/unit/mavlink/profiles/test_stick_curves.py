"""A policy's sticks on vehicles with other gains than those of its training."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from helpers.stick_curves import PX4_DEFAULTS, copter_motion, copter_values, policy_motion
from mavbridge.core.vehicle import NEUTRAL, StickGains, Sticks
from mavbridge.mavlink.profiles.ardupilot_sticks import ardupilot_curves, calibration
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.profiles.sticks import IDENTITY, StickCurves
from sitl.ardupilot.params import ArduPilotParams
from sitl.vehicle.conditions import Conditions
from sitl.vehicle.config import VehicleConfig

GAINS = StickGains()
HALF = Conditions(angle_max_cdeg=1500.0, pilot_yaw_rate_degps=101.25, pilot_speed_up_cmps=125.0)
TWICE = Conditions(angle_max_cdeg=6000.0, pilot_yaw_rate_degps=405.0, pilot_speed_up_cmps=500.0)


def values_of(conditions: Conditions) -> dict[str, float]:
    params = ArduPilotParams(VehicleConfig(conditions=conditions))
    return {name: params[name] for name in params.names}


def test_the_vehicle_of_the_training_gets_the_same_sticks() -> None:
    curves = ardupilot_curves(copter_values(), "ALT_HOLD", GAINS)
    sticks = Sticks(throttle=0.123456789, yaw=-0.03, pitch=1.0, roll=-1.0)
    assert curves.is_identity
    assert curves.notes == ()
    assert curves.to_vehicle(sticks) is sticks
    assert curves.to_policy(sticks) is sticks


@pytest.mark.parametrize(
    "conditions", [HALF, TWICE, replace(TWICE, pilot_yaw_expo=0.4)], ids=["half", "twice", "expo"]
)
def test_other_gains_give_the_motion_of_the_training(conditions: Conditions) -> None:
    curves = ardupilot_curves(values_of(conditions), "ALT_HOLD", GAINS)
    for sticks in (
        NEUTRAL,
        Sticks(throttle=0.5, yaw=0.4, pitch=0.3, roll=-0.2),
        Sticks(throttle=-0.5, yaw=-0.4, pitch=-0.3, roll=0.2),
        Sticks(throttle=0.19, yaw=0.03, pitch=0.03, roll=-0.03),
    ):
        moved = copter_motion(curves.to_vehicle(sticks), conditions)
        # A microsecond of PWM is up to 1 degree/s, 0.14 degrees and 0.014 m/s.
        for got, meant, error in zip(
            moved, policy_motion(sticks, GAINS), (0.02, 1.0, 0.2, 0.2), strict=True
        ):
            assert got == pytest.approx(meant, abs=error)


def test_what_the_vehicle_cannot_do_is_said_at_once_for_each_stick() -> None:
    curves = ardupilot_curves(values_of(HALF), "ALT_HOLD", GAINS)
    names = ("PILOT_SPEED_UP", "PILOT_SPEED_UP", "PILOT_Y_RATE", "ANGLE_MAX")
    shares = ("0.60", "0.60", "0.52", "0.52")
    for note, name, share in zip(curves.notes, names, shares, strict=True):
        assert f"({name}): beyond {share} of the stick" in note
    both = Sticks(throttle=0.0, yaw=0.0, pitch=0.4, roll=0.4)  # neither would be too much alone
    moved = curves.to_vehicle(both)
    assert moved.pitch == moved.roll == pytest.approx(0.04 + 0.96 * 0.5**0.5)
    assert ardupilot_curves(values_of(TWICE), "ALT_HOLD", GAINS).notes == ()


def test_the_newer_names_and_units_mean_the_same() -> None:
    old = copter_values(ANGLE_MAX=4500.0, PILOT_SPEED_UP=400.0, PILOT_SPEED_DN=150.0)
    new = dict(old)
    for name in ("ANGLE_MAX", "PILOT_SPEED_UP", "PILOT_SPEED_DN"):
        del new[name]
    new |= {"ATC_ANGLE_MAX": 45.0, "PILOT_SPD_UP": 4.0, "PILOT_SPD_DN": 1.5}
    sticks = Sticks(throttle=-0.4, yaw=0.4, pitch=0.3, roll=-0.2)
    moved = [ardupilot_curves(v, "ALT_HOLD", GAINS).to_vehicle(sticks) for v in (old, new)]
    assert moved[0] == pytest.approx(moved[1])
    assert moved[0].throttle < -0.4


def test_parameters_that_are_missing_or_zero_leave_all_sticks_alone_and_are_named() -> None:
    values = values_of(TWICE)
    del values["ANGLE_MAX"], values["RC4_DZ"]
    curves = ardupilot_curves(values, "ALT_HOLD", GAINS)
    assert curves.is_identity
    assert curves.notes == (
        "the policy's sticks go to the vehicle as they are, whatever they mean to it: it did not "
        "send ANGLE_MAX, RC4_DZ",
    )
    (note,) = ardupilot_curves(values_of(TWICE) | {"PILOT_Y_RATE": 0.0}, "ALT_HOLD", GAINS).notes
    assert note.endswith("whatever they mean to it: PILOT_Y_RATE is 0")
    (note,) = ardupilot_curves({}, "ALT_HOLD", GAINS).notes
    assert "RCMAP_ROLL" in note
    (note,) = PX4.stick_curves({}, "ALTCTL", GAINS).notes
    assert note.endswith("MPC_Z_VEL_MAX_UP, MPC_Z_VEL_MAX_DN, MAN_DEADZONE")
    curves = PX4.stick_curves(PX4_DEFAULTS | {"MPC_MAN_TILT_MAX": 0.0}, "ALTCTL", GAINS)
    assert curves.is_identity
    assert curves.notes[0].endswith("whatever they mean to it: MPC_MAN_TILT_MAX is 0")


@pytest.mark.parametrize(
    ("curves_of", "values", "usual", "modes"),
    [
        (
            *(ardupilot_curves, values_of(TWICE), "ALT_HOLD"),
            ("LOITER", "POSHOLD", "ACRO", "SPORT", "DRIFT", "GUIDED", "17"),
        ),
        (
            *(PX4.stick_curves, PX4_DEFAULTS, "ALTCTL"),
            ("POSCTL", "ACRO", "MANUAL", "OFFBOARD", "AUTO.LOITER"),
        ),
    ],
)
def test_in_other_modes_every_stick_is_left_alone(
    curves_of: Callable[..., StickCurves],
    values: dict[str, float],
    usual: str,
    modes: tuple[str, ...],
) -> None:
    assert all(curves_of(values, mode, GAINS) == IDENTITY for mode in modes)
    assert curves_of(values, usual, None) == IDENTITY  # raw


def test_dead_zones_follow_a_trim_off_the_middle_and_a_reversed_channel() -> None:
    values = copter_values(RC1_TRIM=1600.0, RC1_REVERSED=1.0, RC1_DZ=40.0)
    curves = ardupilot_curves(values, "ALT_HOLD", GAINS)
    rc = calibration(values)
    for roll, dead_us in ((0.04001, -40), (-0.04001, 40)):
        pwm = rc.to_pwm_us(curves.to_vehicle(NEUTRAL._replace(roll=roll)))
        assert pwm[3] == 1600 + dead_us
    assert rc.to_pwm_us(curves.to_vehicle(NEUTRAL._replace(roll=1.0)))[3] == 1000


# --- PX4


@pytest.mark.parametrize(
    ("stick", "position", "measure", "seen", "error"),
    [
        ("roll", 0.5, lambda motion: motion.roll_deg, 19.1, 0.3),
        ("roll", 0.1, lambda motion: motion.roll_deg, 4.0, 0.05),
        ("roll", 0.05, lambda motion: motion.roll_deg, 2.0, 0.05),
        ("pitch", -0.5, lambda motion: motion.pitch_deg, -19.1, 0.3),
        ("throttle", 0.2, lambda motion: motion.climb_mps, 0.15, 0.02),
        ("throttle", 0.5, lambda motion: motion.climb_mps, 0.7, 0.02),
        ("throttle", 1.0, lambda motion: motion.climb_mps, 2.9, 0.11),
        ("throttle", -1.0, lambda motion: motion.climb_mps, -1.35, 0.16),
        ("yaw", 0.5, lambda motion: motion.yaw_degps, 35.0, 1.0),
        ("yaw", 0.1, lambda motion: motion.yaw_degps, 0.0, 0.0),
        ("yaw", 1.0, lambda motion: motion.yaw_degps, 144.0, 6.5),
    ],
)
def test_altctl_does_what_was_measured(
    stick: str, position: float, measure: Callable[..., float], seen: float, error: float
) -> None:
    """MANUAL_CONTROL y 500 gave 19.1 degrees on the firmware, and so on."""
    gains = StickGains(lean_deg=50.0, yaw_rate_degps=300.0, climb_mps=4.0, descent_mps=4.0)
    curves = PX4.stick_curves(PX4_DEFAULTS, "ALTCTL", gains)
    sent = NEUTRAL._replace(**{stick: position})
    meant = curves.to_policy(sent)
    assert measure(policy_motion(meant, gains)) == pytest.approx(seen, abs=error)
    if position != 0.1 or stick != "yaw":
        assert curves.to_vehicle(meant) == pytest.approx(sent)


def test_stabilized_leans_in_proportion_as_was_measured() -> None:
    curves = PX4.stick_curves(PX4_DEFAULTS, "STABILIZED", GAINS)
    meant = curves.to_policy(Sticks(throttle=0.3, yaw=0.0, pitch=0.0, roll=0.5))
    assert policy_motion(meant, GAINS).roll_deg == pytest.approx(17.2, abs=0.4)
    assert meant.throttle == 0.3  # thrust


def test_older_versions_have_expos_of_their_own_and_another_name_of_the_dead_zone() -> None:
    old = {name: value for name, value in PX4_DEFAULTS.items() if name != "MAN_DEADZONE"}
    old |= {"MPC_HOLD_DZ": 0.2, "MPC_YAW_EXPO": 0.0, "MPC_Z_MAN_EXPO": 1.0}
    curves = PX4.stick_curves(old, "ALTCTL", StickGains(yaw_rate_degps=150.0, yaw_dead_zone=0.2))
    assert curves.yaw is None  # a straight line, as the policy's
    sticks = NEUTRAL._replace(throttle=0.2 + 0.8 * 3.0 / 2.5 / 8.0)  # an eighth of 3 m/s
    assert curves.to_vehicle(sticks).throttle == pytest.approx(0.2 + 0.8 * 0.5)
