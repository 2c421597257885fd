"""A class of the user's in a real flight: who calls what, when, and who takes off."""

from pathlib import Path

import pytest

from faults.stage import staged
from helpers.noted_policy import noted_calls, noted_policy

pytestmark = pytest.mark.system

MAIN, VISION, ACTION = "MainThread", "mavbridge-vision", "mavbridge-policy"


def test_a_file_of_the_users_flies_after_a_takeoff_and_lives_by_the_guide(tmp_path: Path) -> None:
    with staged(tmp_path, renders=False) as flying:
        flags = ("--mode", "ALT_HOLD", "--arm", "--takeoff", "2", "--duration", "6")
        status, output = flying.fly("--dual-rate", *flags, "--policy", noted_policy(tmp_path))
    assert status == 0, output
    assert flying.vehicle_report()["max_altitude_m"] > 1.7
    calls = noted_calls(tmp_path)
    assert calls[0] == ("__init__", MAIN)
    assert calls[-1] == ("close", MAIN)
    in_flight = calls[calls.index(("reset", MAIN)) + 1 : -1]
    assert set(in_flight) == {
        ("encode_visual", VISION),
        ("predict_fast", ACTION),
        ("reset", ACTION),
    }
    assert [name for name, _ in calls].count("reset") == 2  # after loading, and for the one flight
