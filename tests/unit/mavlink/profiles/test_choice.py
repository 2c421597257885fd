"""Firmware and vehicles that may be flown, and their outputs."""

import pytest

from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.vehicle import ACTION_CLASSES, Output
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import Profile
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.session.vehicle import require_profile

OUTPUTS: tuple[Output, ...] = ("rc-override", "manual-control", "attitude", "rates", "velocity")


@pytest.mark.parametrize("vehicle_type", [2, 3, 4 + 9, 14, 15, 29, 35])
def test_multirotors_of_two_firmwares_are_flown(vehicle_type: int) -> None:
    assert require_profile(3, vehicle_type) is ARDUPILOT
    assert require_profile(12, vehicle_type) is PX4


@pytest.mark.parametrize(
    ("vehicle_type", "name"),
    [(4, "HELICOPTER"), (1, "FIXED_WING"), (10, "GROUND_ROVER"), (22, "VTOL"), (250, "unknown")],
)
def test_anything_but_a_multirotor_is_refused(vehicle_type: int, name: str) -> None:
    for autopilot in (3, 12):
        with pytest.raises(PeerError, match=rf"{name}.* \(MAV_TYPE {vehicle_type}\).*multirotors"):
            require_profile(autopilot, vehicle_type)


@pytest.mark.parametrize(
    ("autopilot", "name"), [(0, "GENERIC"), (13, "SMACCMPILOT"), (4, "OPENPILOT"), (99, "unknown")]
)
def test_other_firmware_is_refused(autopilot: int, name: str) -> None:
    """Betaflight and INAV call themselves generic."""
    with pytest.raises(PeerError, match=rf"is {name} \(MAV_AUTOPILOT {autopilot}\), and only Ardu"):
        require_profile(autopilot, 2)


@pytest.mark.parametrize("profile", [ARDUPILOT, PX4])
def test_each_kind_of_action_has_an_output_and_what_has_none_says_which(profile: Profile) -> None:
    assert set(profile.outputs) == set(ACTION_CLASSES)
    assert not set(profile.outputs.values()) & set(profile.refusals)
    assert set(profile.outputs.values()) | set(profile.refusals) == set(OUTPUTS)
    for refusal in profile.refusals.values():
        assert f"--output {profile.outputs['sticks']}" in refusal


@pytest.mark.parametrize("profile", [ARDUPILOT, PX4])
def test_every_role_is_a_mode_that_can_be_asked_for(profile: Profile) -> None:
    roles = profile.modes.roles
    named = (roles.hold, roles.land, roles.rtl, *roles.takeoff, *roles.thrust, *roles.setpoint)
    assert set(named) <= set(roles.names)
    for name in roles.names:
        main, sub = profile.modes.command(name)
        custom_mode = main if profile is ARDUPILOT else main << 16 | sub << 24
        assert profile.modes.name(custom_mode) == name


def test_modes_of_a_copter() -> None:
    modes = ARDUPILOT.modes
    assert modes.name(2) == "ALT_HOLD"
    assert modes.command("alt_hold") == (2, 0)
    assert modes.name(99) == "99"
    with pytest.raises(UserError, match="no mode 'HOVER'; it has ACRO"):
        modes.command("HOVER")


@pytest.mark.parametrize(
    ("name", "main", "sub"),
    [
        *(("MANUAL", 1, 0), ("ALTCTL", 2, 0), ("POSCTL", 3, 0), ("ACRO", 5, 0)),
        *(("OFFBOARD", 6, 0), ("STABILIZED", 7, 0), ("AUTO.TAKEOFF", 4, 2), ("AUTO.LOITER", 4, 3)),
        *(("AUTO.MISSION", 4, 4), ("AUTO.RTL", 4, 5), ("AUTO.LAND", 4, 6)),
    ],
)
def test_modes_of_px4_and_their_sub_modes(name: str, main: int, sub: int) -> None:
    assert PX4.modes.name(main << 16 | sub << 24) == name
    assert PX4.modes.command(name.lower()) == (main, sub)


def test_modes_of_px4_without_a_name_of_their_own() -> None:
    modes = PX4.modes
    assert modes.name(3 << 16 | 2 << 24) == "POSCTL"  # slow: flown with sticks all the same
    assert modes.name(4 << 16 | 8 << 24) == "AUTO.8"
    assert modes.name(10 << 16) == "TERMINATION"
    for name in ("AUTO", "AUTO.8", "LOITER", "TERMINATION"):
        with pytest.raises(UserError, match=r"AUTO\.LOITER"):
            modes.command(name)


@pytest.mark.parametrize(
    ("outputs", "message"),
    [
        (("attitude", "rates"), "ATTITUDE_TARGET"),
        (("velocity",), "POSITION_TARGET_LOCAL_NED"),
    ],
)
def test_where_each_output_is_shown(outputs: tuple[Output, ...], message: str) -> None:
    assert PX4.echo("manual-control").messages == ("MANUAL_CONTROL",)
    assert ARDUPILOT.echo("rc-override").messages == ("RC_CHANNELS",)
    for profile in (PX4, ARDUPILOT):
        assert {profile.echo(output).messages for output in outputs} == {(message,)}
