"""Firmware that may be flown, and what its modes, parameters, events and streams mean.

Against the facts measured on ArduCopter 4.7 and PX4 1.18.
"""

import re
from collections.abc import Iterable

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.parameters import SAFE
from mavbridge.core.errors import PeerError, UserError
from mavbridge.core.vehicle import ActionKind, Output
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import NoteKind, ParamContext, ParamNote, Profile
from mavbridge.mavlink.profiles.px4 import PX4, event_id
from mavbridge.mavlink.session.vehicle import require_profile
from policy.contract import STICK_MODES

RCMAP = {"RCMAP_ROLL": 1.0, "RCMAP_PITCH": 2.0, "RCMAP_THROTTLE": 3.0, "RCMAP_YAW": 6.0}
BOTH = pytest.mark.parametrize("profile", [ARDUPILOT, PX4], ids=lambda profile: profile.name)


def notes_of(
    profile: Profile,
    values: dict[str, float],
    output: Output | None,
    *,
    kind: NoteKind = "obstacle",
    has_receiver: bool | None = True,
) -> list[ParamNote]:
    notes = profile.notes(values, ParamContext(output, 255, has_receiver))
    return [note for note in notes if note.kind == kind]


def test_sticks_are_released_only_in_modes_that_hold_the_height() -> None:
    """DRIFT damps the climb alone (get_throttle_assist)."""
    thrust = {*ARDUPILOT.modes.roles.thrust, *PX4.modes.roles.thrust}
    assert {*STICK_MODES} - thrust == {"ALT_HOLD", "LOITER", "POSHOLD", "SPORT", "ALTCTL", "POSCTL"}


@pytest.mark.parametrize("vehicle_type", [2, 3, 4 + 9, 14, 15, 29, 35])
def test_multirotors_of_two_firmwares_are_flown(vehicle_type: int) -> None:
    assert require_profile(3, vehicle_type) is ARDUPILOT
    assert require_profile(12, vehicle_type) is PX4


@pytest.mark.parametrize(
    ("autopilot", "vehicle_type", "told"),
    [
        (3, 4, r"HELICOPTER \(MAV_TYPE 4\).*multirotors"),
        (12, 1, r"FIXED_WING \(MAV_TYPE 1\).*multirotors"),
        (3, 10, "GROUND_ROVER"),
        (12, 22, "VTOL"),
        (3, 250, "unknown"),
        (0, 2, r"is GENERIC \(MAV_AUTOPILOT 0\), and only Ardu"),  # Betaflight, INAV
        (13, 2, "SMACCMPILOT"),
        (99, 2, "unknown"),
    ],
)
def test_other_vehicles_and_firmware_are_refused(
    autopilot: int, vehicle_type: int, told: str
) -> None:
    with pytest.raises(PeerError, match=told):
        require_profile(autopilot, vehicle_type)


@BOTH
@pytest.mark.parametrize("kind", ["sticks", "attitude", "rates", "velocity"])
def test_the_wanted_value_of_a_parameter_is_told_once_whatever_it_is(
    profile: Profile, kind: ActionKind
) -> None:
    output = profile.usual_output(kind)
    wanted = [note.names for note in notes_of(profile, {}, output, kind="wanted")]
    assert len(set(wanted)) == len(wanted) > 1
    read = dict.fromkeys(profile.params, 1.0)
    told = notes_of(profile, read, output, kind="wanted")
    assert {len(note.names) for note in told} == {1}
    assert {note.names[0] for note in told} <= {*profile.params, "SIMPLE", "SUPER_SIMPLE"}
    assert not notes_of(profile, read, None, kind="wanted"), "nothing is sent yet"


def test_the_wanted_values_follow_receiver_output_and_switch() -> None:
    def wanted(output: Output, *, has_receiver: bool) -> dict[str, str]:
        values = {"SYSID_MYGCS": 1.0, "RC7_OPTION": 46.0}
        notes = notes_of(ARDUPILOT, values, output, kind="wanted", has_receiver=has_receiver)
        return {note.names[0]: note.said for note in notes}

    alone = wanted("rc-override", has_receiver=False)
    assert alone["SYSID_MYGCS"] == "255, our system id"
    assert alone["RC7_OPTION"] == "46, with its switch on"
    assert (alone["FS_THR_ENABLE"], alone["FS_OPTIONS"]) == (
        "not 0, without a receiver",
        "24 (bit 3 set)",
    )
    assert wanted("rc-override", has_receiver=True)["FS_OPTIONS"] == "any"
    assert wanted("rates", has_receiver=False)["FS_THR_ENABLE"] == "0"
    assert wanted("rates", has_receiver=True)["ATC_ANGLE_BOOST"] == "any"
    assert "GUID_OPTIONS" not in wanted("velocity", has_receiver=True)


@BOTH
def test_every_role_is_a_mode_that_can_be_asked_for(profile: Profile) -> None:
    roles = profile.modes.roles
    named = (roles.hold, roles.land, roles.rtl, *roles.takeoff, *roles.thrust, *roles.setpoint)
    assert set(named) <= set(roles.names)
    for name in roles.names:
        command, (_, main, sub) = profile.modes.command(name)
        assert command == dialect.MAV_CMD_DO_SET_MODE
        custom_mode = main if profile is ARDUPILOT else main << 16 | sub << 24
        assert profile.modes.name(custom_mode) == name


def test_modes_of_px4_without_a_name_of_their_own() -> None:
    modes = PX4.modes
    assert modes.name(3 << 16 | 2 << 24) == "POSCTL"  # slow: flown with sticks all the same
    assert modes.name(3 << 16 | 1 << 24) == "POSCTL.ORBIT"  # DO_ORBIT of a station: a takeover
    assert modes.name(4 << 16 | 8 << 24) == "AUTO"
    assert modes.name(10 << 16) == "TERMINATION"
    for name in ("AUTO", "AUTO.8", "LOITER", "TERMINATION"):
        with pytest.raises(UserError, match=r"AUTO\.LOITER"):
            modes.command(name)


@pytest.mark.parametrize(
    ("profile", "values", "output", "has_receiver", "expected"),
    [
        (ARDUPILOT, {"GUID_TIMEOUT": 3.0}, "velocity", True, ["--set GUID_TIMEOUT=0.5"]),
        (ARDUPILOT, {"FS_THR_ENABLE": 1.0}, "velocity", False, ["--set FS_THR_ENABLE=0"]),
        (ARDUPILOT, {"FS_THR_ENABLE": 1.0}, "velocity", None, []),  # not known yet
        (ARDUPILOT, {"ATC_ANGLE_BOOST": 0.0}, "attitude", True, ["ATC_ANGLE_BOOST is 0"]),
        (ARDUPILOT, {"ATC_ANGLE_BOOST": 0.0}, "rates", True, []),
        (ARDUPILOT, {"GUID_TIMEOUT": 3.0, "ATC_ANGLE_BOOST": 0.0}, None, False, []),
        (ARDUPILOT, SAFE, "rc-override", True, []),
        *(
            (ARDUPILOT, SAFE | {name: 9.0}, "rc-override", True, [f"--set {name}=0"])
            for name in ("PILOT_TKO_ALT_M", "PILOT_TKOFF_ALT")
        ),
        (ARDUPILOT, {"PILOT_TKO_ALT_M": 9.0}, "velocity", True, []),
        (PX4, {"COM_RC_LOSS_T": 0.5, "NAV_RCL_ACT": 2.0}, "manual-control", None, []),
        (PX4, {"COM_RC_LOSS_T": 2.0}, "manual-control", None, ["--set COM_RC_LOSS_T=0.5"]),
        *(
            (profile, values | {name: 0.1}, output, False, [f"--set {name}=0.5"])
            for profile, values, name, output in (
                (PX4, {}, "COM_RC_LOSS_T", "manual-control"),
                (PX4, {}, "COM_OF_LOSS_T", "velocity"),
                (ARDUPILOT, SAFE, "RC_OVERRIDE_TIME", "rc-override"),
                (ARDUPILOT, SAFE, "RC_FS_TIMEOUT", "rc-override"),
                (ARDUPILOT, {}, "GUID_TIMEOUT", "rates"),
            )
        ),
        (PX4, {"NAV_RCL_ACT": 6.0}, "manual-control", None, ["NAV_RCL_ACT is 6: it would disarm"]),
        *(
            (profile, values | {full: 35.0, limit: most}, output, True, told)
            for profile, values, output, full, limit in (
                (PX4, {}, "manual-control", "MPC_MAN_TILT_MAX", "MPC_TILTMAX_AIR"),
                (PX4, {}, "manual-control", "MPC_MAN_Y_MAX", "MC_YAWRATE_MAX"),
                (ARDUPILOT, SAFE, "rc-override", "PILOT_Y_RATE", "ATC_RATE_Y_MAX"),
            )
            for most, told in ((20.0, [f"--set {limit}=35"]), (35.0, []), (0.0, []))
        ),
        (PX4, {"MPC_THR_CURVE": 1.0}, "manual-control", None, ["--set MPC_THR_CURVE=0"]),
        (PX4, {"COM_RC_IN_MODE": 6.0}, "manual-control", True, ["take over by --engage-channel"]),
        (PX4, {"COM_RC_IN_MODE": 6.0}, "manual-control", False, []),
        (PX4, {"COM_RC_IN_MODE": 3.0}, "manual-control", True, ["the receiver was there first"]),
        (PX4, {"COM_RC_IN_MODE": 3.0}, "manual-control", False, []),
        (PX4, {"MPC_THR_CURVE": 1.0, "MPC_TILTMAX_AIR": 1.0}, "rates", None, []),
        (PX4, {"COM_RC_LOSS_T": 2.0, "NAV_RCL_ACT": 6.0}, "velocity", None, []),
        (PX4, {"COM_OF_LOSS_T": 5.0}, "velocity", None, ["--set COM_OF_LOSS_T=0.5"]),
        (PX4, {"COM_OBL_RC_ACT": 7.0}, "rates", None, ["COM_OBL_RC_ACT is 7: it would disarm"]),
    ],
)
def test_advice(
    profile: Profile,
    values: dict[str, float],
    output: Output | None,
    has_receiver: bool | None,
    expected: list[str],
) -> None:
    notes = notes_of(profile, values, output, kind="advice", has_receiver=has_receiver)
    assert len(notes) == len(expected)
    for note, part in zip(notes, expected, strict=True):
        assert part in note.text


@pytest.mark.parametrize(
    ("values", "output", "expected"),
    [
        ({}, "attitude", "has not sent GUID_OPTIONS"),
        ({"GUID_OPTIONS": 0.0}, "attitude", "GUID_OPTIONS is 0.*climb rate.*--set GUID_OPTIONS=8"),
        ({"GUID_OPTIONS": 1.0}, "rates", "--set GUID_OPTIONS=9"),
        ({"GUID_OPTIONS": 9.0}, "rates", None),
        ({"GUID_OPTIONS": 16.0}, "velocity", None),
        ({"GUID_OPTIONS": 40.0}, "velocity", "GUID_OPTIONS is 40.*our vel.*--set GUID_OPTIONS=8"),
        ({"Q_ENABLE": 1.0}, "velocity", "an ArduPlane"),
        ({"Q_ENABLE": 0.0}, "rc-override", "an ArduPlane"),
        ({"MAV_GCS_SYSID": 255.0}, "rc-override", None),
        ({"MAV_GCS_SYSID": 42.0}, "rc-override", "--set-config link.source_system=42"),
        ({"MAV_GCS_SYSID": 240.0, "MAV_GCS_SYSID_HI": 255.0}, "rc-override", None),
        ({"MAV_GCS_SYSID": 240.0, "MAV_GCS_SYSID_HI": 0.0}, "rc-override", "obeys system 240"),
        ({"SYSID_MYGCS": 252.0}, "rc-override", "obeys system 252"),
        ({"RC_OPTIONS": 34.0}, "rc-override", "RC_OPTIONS is 34, .* bit 1 .* --set RC_OPTIONS=32"),
        ({"RC_OPTIONS": 32.0}, "rc-override", None),
        *(
            ({"RC8_OPTION": 46.0, "RC_OPTIONS": 160.0} | reversed_, "rc-override", told)
            for reversed_, told in (
                ({"RC8_REVERSED": 1.0}, "bit 7 reverses RC8.* --set RC_OPTIONS=32"),
                ({"RC8_REVERSED": 0.0, "RC7_REVERSED": 1.0}, None),
            )
        ),
        ({"RC_OVERRIDE_TIME": 0.0}, "rc-override", "RC_OVERRIDE_TIME is 0"),
        # switches of the pilot's own
        *(
            (RCMAP | {name: value}, "rc-override", None)
            for name, value in (("RC7_OPTION", 4.0), ("RC8_OPTION", 46.0), ("FLTMODE_CH", 5.0))
        ),
    ],
)
def test_what_a_copter_would_not_follow_is_an_obstacle(
    values: dict[str, float], output: Output, expected: str | None
) -> None:
    found = "; ".join(note.text for note in notes_of(ARDUPILOT, values, output))
    assert re.search(expected, found) if expected else found == ""


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("SIMPLE", 63.0),
        ("SIMPLE", 1.0),
        ("SUPER_SIMPLE", 8.0),
        ("RC7_OPTION", 3.0),
        ("RC12_OPTION", 13.0),
        ("RC4_OPTION", 3.0),  # no stick is on this channel
        ("RC3_OPTION", 153.0),  # the throttle arms
        ("RC6_OPTION", 4.0),  # the yaw stick returns home
        ("FLTMODE_CH", 6.0),
    ],
)
def test_what_turns_a_stick_is_refused_with_what_mends_it(name: str, value: float) -> None:
    (note,) = notes_of(ARDUPILOT, RCMAP | {name: value}, "rc-override")
    flag, _, mended = note.cure.partition("=")
    assert (note.names, flag) == ((name,), f"--set {name}")
    assert notes_of(ARDUPILOT, RCMAP | {name: float(mended)}, "rc-override") == []
    assert notes_of(ARDUPILOT, RCMAP | {name: value}, "velocity") == []


@pytest.mark.parametrize("has_receiver", [None, True, False])
@pytest.mark.parametrize("time_s", [1.0, 5.0])
def test_a_late_radio_failsafe_is_told_where_it_alone_ends_the_last_sticks(
    time_s: float, has_receiver: bool | None
) -> None:
    """Measured: 5 s of RC_FS_TIMEOUT without a receiver are 5 s with the last lean."""
    values = {"RC_FS_TIMEOUT": time_s}
    notes = notes_of(ARDUPILOT, values, "rc-override", kind="advice", has_receiver=has_receiver)
    is_told = any("--set RC_FS_TIMEOUT=0.5" in note.text for note in notes)
    assert is_told is (time_s > 1.0 and has_receiver is False)


@pytest.mark.parametrize(
    ("change", "is_refused"),
    [
        ({}, False),
        ({"RC1_TRIM": 1981.0}, True),
        ({"RC1_TRIM": 2000.0}, True),
        ({"RC2_TRIM": 1000.0, "RC2_DZ": 0.0}, True),
        ({"RC1_MIN": 1490.0}, True),
        ({"RC2_DZ": 600.0}, True),
        ({"RC3_DZ": 600.0}, False),  # the throttle counts from the bottom
    ],
)
def test_a_half_of_a_stick_inside_its_dead_zone_is_refused(
    change: dict[str, float], is_refused: bool
) -> None:
    usual = {"MIN": 1000.0, "TRIM": 1500.0, "MAX": 2000.0, "DZ": 20.0}
    radio = {f"RC{n}_{part}": value for n in (1, 2, 3, 6) for part, value in usual.items()}
    notes = notes_of(ARDUPILOT, RCMAP | radio | change, "rc-override")
    assert [note.kind for note in notes] == ["obstacle"] * is_refused
    assert all("hides one half of the stick of RCMAP_" in note.text for note in notes)


def test_a_receiver_that_is_ignored_holds_no_stick() -> None:
    for bits, is_ignored in ((1.0, True), (33.0, True), (32.0, False), (2.0, False)):
        assert ARDUPILOT.traits({"RC_OPTIONS": bits}).ignores_receiver is is_ignored


@pytest.mark.parametrize(
    ("name", "values", "receiver", "refused", "mended"),
    [
        ("COM_RC_IN_MODE", range(9), False, (0, 4), 1),
        ("COM_RC_IN_MODE", (0, 1, 2, 3, 4, 6, 8), True, (0, 4), 1),
        ("COM_RC_IN_MODE", (5, 7), True, (5, 7), 6),
        ("MAN_KILL_GEST_T", (-1, 0, 2), None, (0, 2), -1),
    ],
)
def test_sticks_of_mavlink_must_be_taken_and_no_gesture_may_stop_the_motors(
    name: str, values: Iterable[int], receiver: bool | None, refused: tuple[int, ...], mended: int
) -> None:
    for value in values:
        found = notes_of(PX4, {name: float(value)}, "manual-control", has_receiver=receiver)
        assert [note.cure for note in found] == [f"--set {name}={mended}"] * (value in refused)
        assert notes_of(PX4, {name: float(value)}, "rates") == []
        is_ignored = name == "COM_RC_IN_MODE" and value in (1, 4)
        assert PX4.traits({name: float(value)}).ignores_receiver is is_ignored


@pytest.mark.parametrize(
    ("name", "number", "told"),
    [
        ("commander_armed_by", 0x190CAF3, {"is_armed": True}),
        ("commander_disarmed_by", 0x1F46777, {"is_armed": False}),
        ("commander_failsafe_enter_hold", 0x1D11DF6, {"is_failsafe": True}),
        ("commander_failsafe_enter", 0x194CA8A, {}),
        ("commander_rc_lost", 0x155CD44, {"is_stick_loss": True}),
    ],
)
def test_numbers_of_events_are_those_that_the_firmware_sent(
    name: str, number: int, told: dict[str, object]
) -> None:
    assert event_id(name) == number
    assert {key: getattr(PX4.events[number], key) for key in told} == told
    assert 0x1A893E0 not in PX4.events  # arming checks, every two seconds


@pytest.mark.parametrize(
    ("profile", "name", "sticks"),
    [(PX4, "COM_OF_LOSS_T", "manual-control"), (ARDUPILOT, "GUID_TIMEOUT", "rc-override")],
)
def test_a_last_setpoint_that_stays_for_long_has_to_be_accepted(
    profile: Profile, name: str, sticks: Output
) -> None:
    for output in ("attitude", "rates", "velocity"):
        assert notes_of(profile, {name: 3.0}, output, kind="risk") == []
        (risk,) = notes_of(profile, {name: 3.5}, output, kind="risk")
        assert (risk.risk, f"--set {name}=0.5" in risk.cure) == ("long-setpoint", True)
    assert notes_of(profile, {name: 3.5}, sticks, kind="risk") == []
