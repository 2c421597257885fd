"""The pilot's sticks in a log of a ground station."""

from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as dialect

from mavbridge.core.vehicle import Sticks
from mavbridge.simulation.replay.telemetry_log import PilotSticks, open_log

PARAMS = {
    "RCMAP_ROLL": 1,
    "RCMAP_PITCH": 2,
    "RCMAP_THROTTLE": 4,
    "RCMAP_YAW": 3,
    **{f"RC{number}_MIN": 1000 for number in range(1, 5)},
    **{f"RC{number}_TRIM": 1500 for number in range(1, 5)},
    **{f"RC{number}_MAX": 2000 for number in range(1, 5)},
    **{f"RC{number}_REVERSED": float(number == 1) for number in range(1, 5)},
}


def write(path: Path, messages: list[dialect.MAVLink_message]) -> Path:
    mav = dialect.MAVLink(None, srcSystem=1, srcComponent=1)
    with path.open("wb") as file:
        for number, message in enumerate(messages):
            file.write(number.to_bytes(8, "big") + message.pack(mav))
    return path


def pilot_of(path: Path) -> tuple[list[Sticks], str | None]:
    log = open_log(path)
    pilot = PilotSticks(log, None)
    found = [pilot.receive(packet) for _, packet in log.packets()]
    return [sticks for sticks in found if sticks is not None], pilot.note


ATTITUDE = dialect.MAVLink_attitude_message(1, 0, 0, 0, 0, 0, 0)
CHANNELS = (1600, 1600, 1600, 1600, *[1500] * 4, *[0] * 10, 255)
RC = dialect.MAVLink_rc_channels_message(1, 8, *CHANNELS)


def test_sticks_go_through_the_calibration_that_the_log_holds(tmp_path: Path) -> None:
    heartbeat = dialect.MAVLink_heartbeat_message(2, 3, 0, 2, 4, 3)
    params = [
        dialect.MAVLink_param_value_message(name.encode(), value, 9, len(PARAMS), 0)
        for name, value in PARAMS.items()
    ]

    sticks, note = pilot_of(write(tmp_path / "a.tlog", [heartbeat, *params, ATTITUDE, RC]))

    assert sticks == [pytest.approx((0.2, 0.2, -0.2, -0.2))]  # roll is reversed, pitch always
    assert note is None


def test_without_one_the_defaults_are_taken_and_said(tmp_path: Path) -> None:
    sticks, note = pilot_of(write(tmp_path / "a.tlog", [ATTITUDE, RC]))

    assert sticks == [pytest.approx((0.25, 0.25, -0.25, 0.25))]
    assert note is not None


def test_sticks_that_the_vehicle_shows_itself_come_before_its_channels(tmp_path: Path) -> None:
    shown = dialect.MAVLink_manual_control_message(1, 100, 200, 750, 300, 0)

    sticks, note = pilot_of(write(tmp_path / "a.tlog", [ATTITUDE, shown, RC]))

    assert sticks == [pytest.approx((0.5, 0.3, 0.1, 0.2))]
    assert note is None
