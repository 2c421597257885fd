"""A policy's sticks on a PX4 multicopter."""

from collections.abc import Callable

import pytest

from helpers.stick_curves import PX4_DEFAULTS, policy_motion
from mavbridge.core.vehicle import NEUTRAL, StickGains, Sticks
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.profiles.px4_sticks import px4_curves
from mavbridge.mavlink.profiles.sticks import IDENTITY

GAINS = StickGains()


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
    curves = px4_curves(PX4_DEFAULTS, "ALTCTL", gains)
    sent = NEUTRAL._replace(**{stick: position})
    meant = curves.to_policy(sent)
    assert measure(policy_motion(meant, gains)) == pytest.approx(seen, abs=error)
    if position != 0.1 or stick != "yaw":
        assert curves.to_vehicle(meant) == pytest.approx(sent)


def test_stabilized_leans_in_proportion_as_was_measured() -> None:
    curves = px4_curves(PX4_DEFAULTS, "STABILIZED", GAINS)
    meant = curves.to_policy(Sticks(throttle=0.3, yaw=0.0, pitch=0.0, roll=0.5))
    assert policy_motion(meant, GAINS).roll_deg == pytest.approx(17.2, abs=0.4)
    assert meant.throttle == 0.3  # thrust


def test_what_the_vehicle_cannot_do_is_said_at_once_and_named_stick_by_stick() -> None:
    values = PX4_DEFAULTS | {"MPC_Z_VEL_MAX_UP": 1.2, "MPC_MAN_TILT_MAX": 20.0}
    curves = px4_curves(values, "ALTCTL", GAINS)
    names = ("MPC_Z_VEL_MAX_UP", "MPC_Z_VEL_MAX_DN", "MPC_MAN_Y_MAX", "MPC_MAN_TILT_MAX")
    shares = ("0.58", "0.68", "0.75", "0.68")
    for note, name, share in zip(curves.notes, names, shares, strict=True):
        assert f"({name}): beyond {share} of the stick" in note
    full = Sticks(throttle=1.0, yaw=1.0, pitch=0.0, roll=-1.0)
    assert curves.saturated(full) == ("throttle", "yaw", "roll")
    assert curves.to_vehicle(full) == full
    back = curves.to_policy(full)
    assert back == pytest.approx((0.584, 0.75111, 0.0, -0.68), abs=1e-5)


def test_the_profile_has_read_all_that_the_curves_need() -> None:
    values = PX4_DEFAULTS | {"MPC_YAW_EXPO": 0.3, "MPC_Z_MAN_EXPO": 0.4}
    read = {name: value for name, value in values.items() if name in PX4.params}
    assert PX4.stick_curves(read, "ALTCTL", GAINS) == px4_curves(values, "ALTCTL", GAINS)
    assert read == values


def test_older_versions_have_expos_of_their_own_and_another_name_of_the_dead_zone() -> None:
    old = {name: value for name, value in PX4_DEFAULTS.items() if name != "MAN_DEADZONE"}
    old |= {"MPC_HOLD_DZ": 0.2, "MPC_YAW_EXPO": 0.0, "MPC_Z_MAN_EXPO": 1.0}
    curves = px4_curves(old, "ALTCTL", StickGains(yaw_rate_degps=150.0, yaw_dead_zone=0.2))
    assert curves.yaw is None  # a straight line, as the policy's
    sticks = NEUTRAL._replace(throttle=0.2 + 0.8 * 3.0 / 2.5 / 8.0)  # an eighth of 3 m/s
    assert curves.to_vehicle(sticks).throttle == pytest.approx(0.2 + 0.8 * 0.5)


@pytest.mark.parametrize("mode", ["POSCTL", "ACRO", "MANUAL", "OFFBOARD", "AUTO.LOITER"])
def test_in_other_modes_every_stick_is_left_alone(mode: str) -> None:
    assert px4_curves(PX4_DEFAULTS, mode, GAINS) == IDENTITY
    assert px4_curves(PX4_DEFAULTS, "ALTCTL", None) == IDENTITY  # raw


def test_parameters_that_are_missing_or_zero_leave_all_sticks_alone_and_are_named() -> None:
    (note,) = px4_curves({}, "ALTCTL", GAINS).notes
    assert note == (
        "the policy's sticks go to the vehicle as they are, whatever they mean to it: it did not "
        "send MPC_MAN_TILT_MAX, MPC_MAN_Y_MAX, MPC_Z_VEL_MAX_UP, MPC_Z_VEL_MAX_DN, MAN_DEADZONE"
    )
    curves = px4_curves(PX4_DEFAULTS | {"MPC_MAN_TILT_MAX": 0.0}, "ALTCTL", GAINS)
    assert curves.is_identity
    assert curves.notes[0].endswith("whatever they mean to it: MPC_MAN_TILT_MAX is 0")
