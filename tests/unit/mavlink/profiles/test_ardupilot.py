"""What ArduCopter's parameters mean for a flight, against the facts measured on 4.7."""

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.vehicle import Output
from mavbridge.mavlink.codec.messages import CommandRequest
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.ardupilot_sticks import stick_settings
from mavbridge.mavlink.profiles.profile import ParamContext


def context(output: Output | None, *, has_receiver: bool | None = True) -> ParamContext:
    return ParamContext(output, 255, has_receiver)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (None, "has not sent GUID_OPTIONS"),
        (0.0, "GUID_OPTIONS is 0.*climb rate.*--set GUID_OPTIONS=8"),
        (1.0, "--set GUID_OPTIONS=9"),
        (8.0, None),
        (9.0, None),
    ],
)
def test_thrust_must_be_thrust(options: float | None, expected: str | None) -> None:
    values = {} if options is None else {"GUID_OPTIONS": options}
    for output in ("attitude", "rates"):
        found = "; ".join(note.text for note in ARDUPILOT.obstacles(values, context(output)))
        if expected is None:
            assert found == ""
        else:
            with pytest.raises(AssertionError, match=expected):
                assert found == ""
    assert list(ARDUPILOT.obstacles(values, context("velocity"))) == []
    assert list(ARDUPILOT.obstacles(values, context("rc-override"))) == []


RCMAP = {"RCMAP_ROLL": 1.0, "RCMAP_PITCH": 2.0, "RCMAP_THROTTLE": 3.0, "RCMAP_YAW": 6.0}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("SIMPLE", 63.0),
        ("SIMPLE", 1.0),
        ("SUPER_SIMPLE", 8.0),
        ("RC7_OPTION", 3.0),
        ("RC12_OPTION", 13.0),
        ("RC3_OPTION", 153.0),  # the throttle arms
        ("RC6_OPTION", 4.0),  # the yaw stick returns home
        ("FLTMODE_CH", 6.0),
    ],
)
def test_what_turns_a_stick_is_refused_with_what_mends_it(name: str, value: float) -> None:
    settings = {each.name: each for each in stick_settings(RCMAP)}
    (note,) = ARDUPILOT.obstacles(RCMAP | {name: value}, context("rc-override"))
    mended = settings[name].mended

    assert (note.names, note.cure) == ((name,), f"--set {name}={mended:g}")
    assert list(ARDUPILOT.obstacles(RCMAP | {name: mended}, context("rc-override"))) == []
    assert list(ARDUPILOT.obstacles(RCMAP | {name: value}, context("velocity"))) == []


@pytest.mark.parametrize(
    ("name", "value"), [("RC7_OPTION", 4.0), ("RC8_OPTION", 46.0), ("FLTMODE_CH", 5.0)]
)
def test_a_switch_of_the_pilots_own_is_none_of_our_sticks(name: str, value: float) -> None:
    assert list(ARDUPILOT.obstacles(RCMAP | {name: value}, context("rc-override"))) == []


def test_a_receiver_that_is_ignored_holds_no_stick() -> None:
    assert [
        ARDUPILOT.ignores_receiver({"RC_OPTIONS": bits}) for bits in (1.0, 33.0, 32.0, 2.0)
    ] == [
        *(True, True),
        *(False, False),
    ]


@pytest.mark.parametrize(
    ("values", "output", "has_receiver", "expected"),
    [
        ({"GUID_TIMEOUT": 3.0}, "velocity", True, ["--set GUID_TIMEOUT=0.5"]),
        ({"GUID_TIMEOUT": 0.5}, "velocity", True, []),
        ({"FS_THR_ENABLE": 1.0}, "velocity", False, ["--set FS_THR_ENABLE=0"]),
        ({"FS_THR_ENABLE": 1.0}, "velocity", None, []),  # not known yet
        ({"FS_THR_ENABLE": 0.0}, "velocity", False, []),
        ({"ATC_ANGLE_BOOST": 0.0}, "attitude", True, ["ATC_ANGLE_BOOST is 0"]),
        ({"ATC_ANGLE_BOOST": 0.0}, "rates", True, []),
        ({"ATC_ANGLE_BOOST": 0.0}, "velocity", True, []),
        ({"ATC_ANGLE_BOOST": 1.0}, "attitude", True, []),
        ({"GUID_TIMEOUT": 3.0, "ATC_ANGLE_BOOST": 0.0}, None, False, []),
    ],
)
def test_advice_for_setpoints(
    values: dict[str, float], output: Output | None, has_receiver: bool | None, expected: list[str]
) -> None:
    notes = list(ARDUPILOT.advice(values, context(output, has_receiver=has_receiver)))
    assert len(notes) == len(expected)
    for note, part in zip(notes, expected, strict=True):
        assert part in note.text


def test_setpoints_that_stop_are_never_held_for_ever() -> None:
    values = {"RC_OVERRIDE_TIME": -1.0, "FS_THR_ENABLE": 0.0}
    assert list(ARDUPILOT.dangers(values, context("velocity", has_receiver=False))) == []
    assert len(list(ARDUPILOT.dangers(values, context("rc-override", has_receiver=False)))) == 2


def test_a_takeoff_is_asked_for_by_height_above_home() -> None:
    command = CommandRequest(dialect.MAV_CMD_NAV_TAKEOFF, (0, 0, 0, 0, 0, 0, 8.0))
    assert ARDUPILOT.takeoff(8.0, None) == ARDUPILOT.takeoff(8.0, 489.0) == command
    assert ARDUPILOT.hover_thrust({"MOT_THST_HOVER": 0.39}) == 0.39
    assert ARDUPILOT.hover_thrust({}) is None
