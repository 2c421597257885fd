"""What PX4's parameters, events and streams mean, against the facts measured on 1.18."""

import math

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.vehicle import Output
from mavbridge.mavlink.profiles.ardupilot import ARDUPILOT
from mavbridge.mavlink.profiles.profile import ParamContext, Profile
from mavbridge.mavlink.profiles.px4 import PX4, event_id


def context(output: Output | None) -> ParamContext:
    return ParamContext(output, 255, None)


@pytest.mark.parametrize("mode", range(9))
def test_sticks_of_mavlink_must_be_taken(mode: int) -> None:
    found = list(PX4.obstacles({"COM_RC_IN_MODE": float(mode)}, context("manual-control")))
    assert bool(found) == (mode in (0, 4))
    assert all(note.cure == "--set COM_RC_IN_MODE=1" for note in found)
    assert list(PX4.obstacles({"COM_RC_IN_MODE": float(mode)}, context("rates"))) == []
    assert PX4.ignores_receiver({"COM_RC_IN_MODE": float(mode)}) == (mode in (1, 4))


@pytest.mark.parametrize("time_s", [-1.0, 0.0, 2.0])
def test_no_gesture_of_the_policys_may_stop_the_motors(time_s: float) -> None:
    notes = PX4.obstacles({"MAN_KILL_GEST_T": time_s}, context("manual-control"))
    assert [note.cure for note in notes] == ["--set MAN_KILL_GEST_T=-1"] * (time_s >= 0)
    assert list(PX4.obstacles({"MAN_KILL_GEST_T": time_s}, context("rates"))) == []


@pytest.mark.parametrize(
    ("values", "output", "expected"),
    [
        ({}, "manual-control", []),
        ({"COM_RC_LOSS_T": 0.5, "NAV_RCL_ACT": 2.0}, "manual-control", []),
        ({"COM_RC_LOSS_T": 2.0}, "manual-control", ["--set COM_RC_LOSS_T=0.5"]),
        ({"COM_RC_LOSS_T": 0.1}, "manual-control", ["as short as that is a failsafe"]),
        ({"NAV_RCL_ACT": 6.0}, "manual-control", ["NAV_RCL_ACT is 6: it would disarm"]),
        ({"NAV_RCL_ACT": 5.0}, "manual-control", ["terminate the flight"]),
        (
            {"MPC_MAN_TILT_MAX": 35.0, "MPC_TILTMAX_AIR": 20.0},
            "manual-control",
            ["--set MPC_TILTMAX_AIR=35"],
        ),
        ({"MPC_MAN_TILT_MAX": 35.0, "MPC_TILTMAX_AIR": 45.0}, "manual-control", []),
        ({"MPC_THR_CURVE": 1.0}, "manual-control", ["--set MPC_THR_CURVE=0"]),
        ({"MPC_THR_CURVE": 1.0, "MPC_TILTMAX_AIR": 1.0}, "rates", []),
        ({"COM_RC_LOSS_T": 2.0, "NAV_RCL_ACT": 6.0}, "velocity", []),
        ({"COM_OF_LOSS_T": 5.0}, "velocity", ["--set COM_OF_LOSS_T=0.5"]),
        ({"COM_OBL_RC_ACT": 7.0}, "rates", ["COM_OBL_RC_ACT is 7: it would disarm"]),
        ({"COM_OF_LOSS_T": 5.0, "COM_RC_LOSS_T": 2.0}, None, []),
    ],
)
def test_advice(values: dict[str, float], output: Output | None, expected: list[str]) -> None:
    notes = list(PX4.advice(values, context(output)))
    assert len(notes) == len(expected)
    for note, part in zip(notes, expected, strict=True):
        assert part in note.text


@pytest.mark.parametrize(
    ("name", "number", "told"),
    [
        ("commander_armed_by", 0x190CAF3, {"is_armed": True}),
        ("commander_disarmed_by", 0x1F46777, {"is_armed": False}),
        ("commander_failsafe_enter_hold", 0x1D11DF6, {"is_failsafe": True}),
        ("commander_failsafe_enter", 0x194CA8A, {}),
        ("commander_rc_lost", 0x155CD44, {"text": "manual control lost"}),
    ],
)
def test_numbers_of_events_are_those_that_the_firmware_sent(
    name: str, number: int, told: dict[str, object]
) -> None:
    assert event_id(name) == number
    assert {key: getattr(PX4.events[number], key) for key in told} == told
    assert 0x1A893E0 not in PX4.events  # arming checks, every two seconds


def test_a_takeoff_is_asked_for_by_height_above_the_sea() -> None:
    command = PX4.takeoff(5.0, 489.4)
    assert command.command == dialect.MAV_CMD_NAV_TAKEOFF
    assert command.params[6] == pytest.approx(494.4)
    assert all(math.isnan(command.params[k]) for k in (3, 4, 5))  # looking as now, here
    assert PX4.takeoff(5.0, None) is None


def test_our_heartbeat_is_a_ground_stations_for_the_sake_of_its_texts() -> None:
    assert PX4.heartbeat_type == dialect.MAV_TYPE_GCS
    assert PX4.hover_thrust({"MPC_THR_HOVER": 0.5}) == 0.5


@pytest.mark.parametrize(
    ("profile", "name", "sticks"),
    [(PX4, "COM_OF_LOSS_T", "manual-control"), (ARDUPILOT, "GUID_TIMEOUT", "rc-override")],
)
def test_a_last_setpoint_that_stays_for_long_has_to_be_accepted(
    profile: Profile, name: str, sticks: Output
) -> None:
    for output in ("attitude", "rates", "velocity"):
        assert list(profile.dangers({name: 3.0}, context(output))) == []
        (danger,) = profile.dangers({name: 3.5}, context(output))
        assert (danger.risk, f"--set {name}=0.5" in danger.cure) == ("long-setpoint", True)
    assert list(profile.dangers({name: 3.5}, context(sticks))) == []
