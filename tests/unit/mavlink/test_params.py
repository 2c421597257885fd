"""Parameters: read, judged before a flight, watched in flight."""

from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from helpers.parameters import SAFE, ParamVehicle
from helpers.wire import CALIBRATION
from mavbridge.core.clock import NS_PER_S
from mavbridge.core.link_settings import LinkSettings, SigningFiles
from mavbridge.core.reasons import Code, because
from mavbridge.core.vehicle import AdviceText, Output, Risk
from mavbridge.mavlink.codec.messages import CommandRequest, ParamWrite
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.px4 import PX4
from mavbridge.mavlink.session.vehicle_params import serial_risks

S = NS_PER_S
SIGNED = SigningFiles(key_file=Path("key"), state_folder=Path("state"))


def after_reading(vehicle: ParamVehicle) -> ParamVehicle:
    vehicle.run(6.0)
    return vehicle


# --- the radio calibration


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"RC1_MIN": None}, "not sent parameter RC1_MIN"),
        ({"RCMAP_ROLL": None}, "not sent parameter RCMAP_ROLL"),
        ({"RCMAP_YAW": 3.0}, "two sticks on one channel"),
        ({"RCMAP_YAW": 0.0}, "RCMAP_YAW is 0, and sticks go to channels 1 to 8: set it, and re"),
        ({"RCMAP_ROLL": 9.0}, "RCMAP_ROLL is 9"),
        ({"RC2_MIN": 700.0}, "--set RC2_MIN=800"),
    ],
)
def test_a_calibration_that_the_codec_would_refuse_later_cannot_be_accepted(
    change: dict[str, float | None], message: str
) -> None:
    every_risk: tuple[Risk, ...] = ("endless-override", "no-throttle-failsafe", "slow-serial")
    vehicle = after_reading(ParamVehicle(change, accepted_risks=every_risk))
    assert vehicle.params.calibration is None
    with pytest.raises(AssertionError, match=message):  # the text of the problem
        assert vehicle.problem() is None
    for name, value in CALIBRATION.items():
        vehicle.set_by_pilot(name, float(value))  # mended by the pilot's ground station
    vehicle.run(4.0)
    assert vehicle.params.calibration is not None
    ((name, before),) = change.items()
    must_reboot = name.startswith("RCMAP_") and before is not None
    assert must_reboot == ("until its next boot" in str(vehicle.problem()))
    assert must_reboot or vehicle.problem() is None


# --- obstacles and risks


@pytest.mark.parametrize(
    ("change", "risk", "cure"),
    [
        ({"RC_OVERRIDE_TIME": -1.0}, "endless-override", "--set RC_OVERRIDE_TIME=0.5"),
        ({"FS_THR_ENABLE": 0.0}, "no-throttle-failsafe", "--set FS_THR_ENABLE=1"),
    ],
)
def test_a_risk_is_refused_until_it_is_accepted_or_mended(
    change: dict[str, float | None], risk: Risk, cure: str
) -> None:
    refused = after_reading(ParamVehicle(change))
    problem = refused.problem()
    assert (problem.code, dict(problem.data)["risk"]) == (Code.RISK, risk)
    assert cure in str(problem)
    assert f"--set-config link.accept_risk={risk}" in str(problem)
    refused.has_receiver = True  # which makes up for a disabled throttle failsafe
    assert (refused.problem() is None) is (risk == "no-throttle-failsafe")
    for name in change:
        refused.set_by_pilot(name, 1.0)
    assert refused.problem() is None

    accepted = after_reading(ParamVehicle(change, accepted_risks=(risk,)))
    assert accepted.problem() is None
    later = after_reading(ParamVehicle(accepted_risks=(risk,)))
    later.armed = True
    for name, value in change.items():
        later.set_by_pilot(name, value)
    assert (later.params.interruption, later.problem()) == (None, None)
    assert any(text.startswith(f"risk {risk} is accepted") for text in accepted.texts)


@pytest.mark.parametrize("change", [{"SIMPLE": 63.0}, {"RC7_OPTION": 13.0}])
def test_a_recording_is_told_what_turns_the_pilots_sticks(change: dict[str, float]) -> None:
    vehicle = after_reading(ParamVehicle(change | {"RC_OPTIONS": 2.0}, pilot_hz=100.0))
    (text,) = vehicle.texts
    assert text.startswith(f"{next(iter(change))} is ")


@pytest.mark.parametrize("is_armed", [True, False])
def test_a_change_by_another_station_is_advised_of_once_armed(is_armed: bool) -> None:
    vehicle = after_reading(ParamVehicle({"GUID_TIMEOUT": 0.5}, output="velocity"))
    vehicle.armed = is_armed
    vehicle.set_by_pilot("GUID_TIMEOUT", 2.0)
    vehicle.run(1.0)
    assert vehicle.params.interruption is None
    assert ["GUID_TIMEOUT is 2" in text for text in vehicle.texts] == [True] * is_armed
    vehicle.armed = True
    vehicle.run(1.0)
    assert ["GUID_TIMEOUT is 2" in text for text in vehicle.texts] == [True]


def test_advice_is_given_once_and_waits_for_what_it_needs_to_know() -> None:
    vehicle = after_reading(ParamVehicle({"GUID_TIMEOUT": 3.0}, output="velocity"))
    assert len(vehicle.texts) == 1
    vehicle.has_receiver = False
    vehicle.run(1.0)
    assert ["GUID_TIMEOUT" in text for text in vehicle.texts] == [True, True, False]
    assert "no receiver was seen" in vehicle.texts[2]
    assert all(isinstance(text, AdviceText) for text in vehicle.texts)  # which is shown once


@pytest.mark.parametrize(
    ("place", "rate_hz", "signing", "enough"),
    [
        ("udp:127.0.0.1:14550", 400, None, None),
        ("/dev/ttyX,57600", 100, None, 230400),
        ("/dev/ttyX,115200", 100, None, 230400),
        ("/dev/ttyX,230400", 100, None, None),
        ("/dev/ttyX,230400", 100, SIGNED, 460800),
        ("/dev/ttyX,115200", 50, None, 230400),
        ("/dev/ttyX,115200", 30, None, None),
        ("/dev/ttyX,230400", 200, None, 460800),
    ],
)
def test_a_serial_port_must_carry_what_is_asked_for(
    place: str, rate_hz: float, signing: SigningFiles | None, enough: int | None
) -> None:
    settings = LinkSettings(connect=place, stick_hz=rate_hz, signing=signing)
    found = serial_risks(settings, ARDUPILOT.streams(state_hz=rate_hz))
    assert len(found) == (enough is not None)
    assert all(f"a serial port of {enough} baud" in each.text for each in found)


def px4_vehicle(changes: dict[str, float | None] | None = None, **settings: Any) -> ParamVehicle:
    usual = {"COM_RC_IN_MODE": 1.0, "COM_RC_LOSS_T": 0.5, "NAV_RCL_ACT": 2.0}
    found: dict[str, float | None] = {**usual, **(changes or {})}
    values = {name: value for name, value in found.items() if value is not None}
    output: Output = settings.pop("output", "manual-control")
    return ParamVehicle(profile=PX4, output=output, values=values, **settings)


def test_a_receiver_that_is_switched_on_in_flight_is_an_obstacle_after_it() -> None:
    vehicle = px4_vehicle({"COM_RC_IN_MODE": 5.0})
    vehicle.has_receiver = False
    after_reading(vehicle).armed = True
    vehicle.has_receiver = True
    assert vehicle.problem() is None
    vehicle.armed = False
    assert vehicle.problem().code is Code.OBSTACLE


@pytest.mark.parametrize(
    ("vehicle", "unread"),
    [
        (ParamVehicle({"FS_THR_ENABLE": None}), "FS_THR_ENABLE"),
        (ParamVehicle({"GUID_TIMEOUT": None}, output="velocity"), "GUID_TIMEOUT"),
        (ParamVehicle({}, output="velocity"), None),
        (
            px4_vehicle({"COM_RC_IN_MODE": None, "COM_RCL_EXCEPT": 2.0, "COM_DISARM_PRFLT": 9.0}),
            "COM_RC_IN_MODE",
        ),
        (px4_vehicle(output="velocity"), "COM_OF_LOSS_T, COM_OBL_RC_ACT, COM_RCL_EXCEPT"),
    ],
)
def test_a_vehicle_without_the_decisive_parameters_is_flown_with_a_warning(
    vehicle: ParamVehicle, unread: str | None
) -> None:
    vehicle.run(10.0)
    assert vehicle.problem() is None
    texts = [text for text in vehicle.texts if "has not sent" in text]
    assert len(texts) == (unread is not None)
    assert all(text.startswith(f"the vehicle has not sent {unread}: ") for text in texts)
    vehicle.armed = True
    vehicle.run(3.0)
    count = len(vehicle.requests)
    vehicle.run(10.0)
    assert len(vehicle.requests) == count  # not asked for in flight


@pytest.mark.parametrize(
    ("names", "times"),
    [
        (("SIMPLE",), 3),
        (("RC7_OPTION",), 3),
        (("THR_DZ",), 0),
        (("SIMPLE", "THR_DZ"), 3),
        (("THR_DZ", "RC7_OPTION", "SUPER_SIMPLE", "RC8_OPTION", "RC_OVERRIDE_TIME"), 3),
    ],
)
def test_simple_mode_that_is_set_off_is_switched_off_as_well(
    names: tuple[str, ...], times: int
) -> None:
    """By its parameter alone it would last until the mode switch moves."""
    wanted = tuple((name, 0.5 if name == "RC_OVERRIDE_TIME" else 0.0) for name in names)
    vehicle = ParamVehicle(dict.fromkeys(names, 13.0), set_params=wanted)
    vehicle.run(10.0)
    off = CommandRequest(dialect.MAV_CMD_DO_AUX_FUNCTION, (3.0, 0.0))

    assert vehicle.writes == list(wanted)
    assert [r for r in vehicle.requests if isinstance(r, CommandRequest)] == [off] * times
    assert vehicle.problem() is None


# --- changes after reading


def test_a_change_on_the_ground_is_taken_in() -> None:
    vehicle = after_reading(ParamVehicle())
    vehicle.set_by_pilot("RC1_MAX", 1950.0)
    vehicle.run(4.0)
    assert vehicle.problem() is None
    assert vehicle.params.interruption is None
    assert vehicle.params.calibration.roll.max_us == 1950


def test_a_stick_that_is_moved_to_another_channel_is_not_flown_before_a_reboot() -> None:
    """ArduPilot reads RCMAP_* at boot alone: roll would go to a channel that it does not read."""
    vehicle = after_reading(ParamVehicle())
    vehicle.set_by_pilot("RCMAP_YAW", 5.0)
    vehicle.run(4.0)
    assert "RCMAP_YAW is 5, and it goes on with 4 until its next boot" in str(vehicle.problem())
    vehicle.set_by_pilot("RCMAP_YAW", 4.0)
    vehicle.run(4.0)
    assert vehicle.problem() is None
    vehicle.set_by_pilot("RCMAP_YAW", 5.0)
    rebooted = after_reading(ParamVehicle(values=vehicle.values))
    assert rebooted.problem() is None
    assert rebooted.params.calibration.yaw.number == 5


@pytest.mark.parametrize(
    ("name", "value", "is_flyable"),
    [
        ("RCMAP_ROLL", 2.0, False),
        ("RC1_MIN", 1000.0, False),
        ("RC1_MAX", 2250.0, False),
        ("RC_OVERRIDE_TIME", -1.0, False),
        ("RC_OPTIONS", 2.0, False),
        ("RC7_OPTION", 46.0, True),  # whether that switch is on is for the session to say
    ],
)
def test_a_change_in_flight_that_matters_interrupts_for_good(
    name: str, value: float, is_flyable: bool
) -> None:
    vehicle = after_reading(ParamVehicle())
    before, old = vehicle.params.calibration, vehicle.values[name]
    vehicle.armed = True
    vehicle.run(1.0)
    vehicle.set_by_pilot(name, value)
    vehicle.run(1.0)
    told = because(Code.PARAMETER_CHANGED, name=name, before=old, after=value)
    assert vehicle.params.interruption == told
    assert vehicle.params.calibration == before  # a release needs the channels of the override
    assert (vehicle.problem() is None) is is_flyable
    vehicle.armed = False
    vehicle.run(1.0)
    assert vehicle.params.interruption == told


def test_other_changes_in_flight_do_not_interrupt() -> None:
    vehicle = after_reading(ParamVehicle())
    vehicle.armed = True
    harmless = {"RC_OVERRIDE_TIME": 0.5, "RC8_OPTION": 9.0, "RC_OPTIONS": 32.0, "RC9_MIN": 900.0}
    heard_again = {"RC1_MAX": vehicle.values["RC1_MAX"]}
    for name, value in (harmless | heard_again).items():
        vehicle.set_by_pilot(name, value)
    vehicle.run(1.0)
    assert (vehicle.params.interruption, vehicle.problem()) == (None, None)


# --- outputs


def test_all_is_read_before_the_output_is_known_and_nothing_is_read_twice() -> None:
    vehicle = after_reading(ParamVehicle({"RC_OVERRIDE_TIME": 3.0}, output=None))
    assert vehicle.problem() is None
    assert vehicle.texts == []  # nobody is advised about an output that may not be used
    assert len({request.name for request in vehicle.requests}) > len(vehicle.params.values)
    vehicle.requests.clear()
    vehicle.params.use_output("rates")
    problem = vehicle.problem()
    assert (problem.code, dict(problem.data)["what"]) == (Code.OBSTACLE, "not fly by our setpoints")
    assert "--set GUID_OPTIONS=8" in str(problem)
    vehicle.set_by_pilot("GUID_OPTIONS", 8.0)
    assert vehicle.problem() is None
    vehicle.run(3.0)
    assert not {request.name for request in vehicle.requests} & set(vehicle.params.values)
    assert [text for text in vehicle.texts if "--set GUID_TIMEOUT=0.5" in text]
    assert not [text for text in vehicle.texts if "RC_OVERRIDE_TIME" in text]


def test_what_was_given_up_before_the_first_answer_is_read_after_it() -> None:
    """The first requests to an autopilot that boots get lost, and a gap of the link is as long."""
    vehicle = ParamVehicle({"RC7_OPTION": 46.0, "RC7_REVERSED": 1.0, "PILOT_Y_RATE": 99.0})
    answered, vehicle.values = vehicle.values, {}
    vehicle.run(6.0)
    assert vehicle.params.is_read
    vehicle.values = answered
    vehicle.run(3.0)
    assert set(vehicle.params.values) == set(answered) & vehicle.params._relevant
    assert vehicle.params.override_switch == 7
    assert vehicle.params.values["RC7_REVERSED"] == 1.0
    assert vehicle.params.values["PILOT_Y_RATE"] == 99.0


@pytest.mark.parametrize("lasts_s", [2.0, 20.0])
def test_what_was_given_up_in_a_gap_of_the_link_is_read_after_it(lasts_s: float) -> None:
    """In the middle of the reading, by a reboot for example: each safety check needs its value."""
    values = dict.fromkeys(ARDUPILOT.params, 7.0) | SAFE | {"PILOT_Y_RATE": 99.0}
    vehicle = ParamVehicle(values=dict(values))
    vehicle.step()
    vehicle.step()
    vehicle.fall_silent()
    vehicle.run(lasts_s)
    vehicle.values |= values
    vehicle.run(2 * lasts_s + 4.0)
    assert vehicle.params._relevant <= set(vehicle.params.values)
    vehicle.requests.clear()
    vehicle.run(20.0)
    assert vehicle.requests == []


def test_what_the_vehicle_lacks_is_asked_for_ever_more_rarely() -> None:
    vehicle = after_reading(ParamVehicle())
    lacking = set(ARDUPILOT.params) - set(vehicle.values)
    vehicle.run(60.0)
    vehicle.requests.clear()
    vehicle.run(60.0)
    assert len(vehicle.requests) <= 2 * 4 * len(lacking)


def test_what_only_another_output_needs_does_not_matter() -> None:
    bad_for_sticks: dict[str, float | None] = {
        "RC_OPTIONS": 2.0,
        "RC_OVERRIDE_TIME": -1.0,
        "RC1_MIN": None,
        "RC7_OPTION": 46.0,
        "FS_THR_ENABLE": 0.0,
    }
    vehicle = after_reading(ParamVehicle(bad_for_sticks, output="velocity"))
    assert vehicle.problem() is None
    assert vehicle.params.override_switch is None


def test_px4s_parameters_are_set_with_their_type_and_put_back() -> None:
    vehicle = px4_vehicle(
        {"COM_RC_IN_MODE": 0.0},
        set_params=(("COM_RC_IN_MODE", 1.0), ("COM_RC_LOSS_T", 0.3)),
    )
    vehicle.integers = {"COM_RC_IN_MODE"}
    vehicle.run(6.0)
    assert vehicle.problem() is None
    assert (vehicle.values["COM_RC_IN_MODE"], vehicle.values["COM_RC_LOSS_T"]) == (1.0, 0.3)
    kinds = {r.name: r.kind for r in vehicle.requests if isinstance(r, ParamWrite)}
    assert kinds == {"COM_RC_IN_MODE": 6, "COM_RC_LOSS_T": 9}
    vehicle.params.changes.restore()
    vehicle.run(3.0)
    assert vehicle.params.changes.restore()
    assert (vehicle.values["COM_RC_IN_MODE"], vehicle.values["COM_RC_LOSS_T"]) == (0.0, 0.5)
