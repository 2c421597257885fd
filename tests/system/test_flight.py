"""The whole product in real processes over UDP. What is asserted is what happened, not how fast."""

import signal
from pathlib import Path

import pytest

from helpers.stand import Flight, Override, flight

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm")
NEUTRAL = Override(1500, 1500, 1500, 1500)
RELEASE = Override(0, 0, 0, 0)


def assert_handed_back(flown: Flight) -> None:
    """Sticks, then neutral, then ten zeros, then nothing."""
    overrides = flown.relay.overrides
    releases = [k for k, sticks in enumerate(overrides) if sticks == RELEASE]
    assert releases == list(range(len(overrides) - 10, len(overrides)))
    assert overrides[-11] == NEUTRAL


def test_takes_off_holds_altitude_and_hands_back(tmp_path: Path) -> None:
    with flight(tmp_path) as flown:
        flown.start(*FLY, "--policy", "scripted:hover", "--duration", "12")
        status, output = flown.end()
    assert status == 0, output
    assert_handed_back(flown)
    vehicle, report = flown.vehicle_report(), flown.report()
    assert 2.0 < vehicle["max_altitude_m"] < 4.5
    assert not vehicle["crashed"]
    assert vehicle["releases"]["count"] == 10
    assert [entry["mode"] for entry in vehicle["modes"]][:2] == ["STABILIZE", "ALT_HOLD"]
    assert report["mode"] == "dual"
    assert report["link"]["echo_confirmed"] is True
    assert report["link"]["sent_overrides"] >= vehicle["overrides"]["count"] > 0
    assert report["vision"]["frames"] > 0
    assert "Arming motors" in output


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_hands_the_sticks_back(tmp_path: Path, number: signal.Signals) -> None:
    with flight(tmp_path) as flown:
        flown.start(*FLY, "--policy", "scripted:hover")
        assert flown.relay.has_flown.wait(60)
        flown.kill(number)
        flown.kill(number)  # an impatient user
        status, output = flown.end()
    assert status == 0, output
    assert_handed_back(flown)
    assert "Traceback" not in output


def test_an_exception_in_the_policy_hands_the_sticks_back(tmp_path: Path) -> None:
    with flight(tmp_path) as flown:
        flown.start(*FLY, "--policy", "helpers.user_policies:Exploding")
        status, output = flown.end()
    assert status == 1
    assert_handed_back(flown)
    assert "RuntimeError: the user's policy is broken" in output
    assert "user_policies.py" in output  # where, for the person who wrote it
    assert "Traceback" not in output


def test_a_policy_that_hangs_loses_the_sticks_for_good(tmp_path: Path) -> None:
    with flight(tmp_path) as flown:
        flown.start(*FLY, "--policy", "helpers.user_policies:Hanging")
        status, output = flown.end()
    assert status == 1
    assert "the action loop has hung" in output
    overrides = flown.relay.overrides
    assert overrides[-10:] == [RELEASE] * 10
    assert RELEASE not in overrides[:-10]  # and the sticks of the thread that came back stayed here


def test_without_arm_and_mode_nothing_is_sent(tmp_path: Path) -> None:
    with flight(tmp_path) as flown:
        flown.start("--dual-rate", "--policy", "scripted:hover")
        assert flown.wait_for("disarmed: arm the vehicle, or start with --arm")
        flown.kill(signal.SIGINT)
        status, output = flown.end()
    assert status == 0, output
    assert flown.relay.overrides == []
    assert [entry["mode"] for entry in flown.vehicle_report()["modes"]] == ["STABILIZE"]


def test_toge_runs_both_loops_untrained(tmp_path: Path) -> None:
    with flight(tmp_path) as flown:
        flags = ("--policy", "toge:small", "--allow-untrained", "--readonly", "--dual-rate")
        flown.start(*flags, "--duration", "4", "--max-feature-age", "2")
        status, output = flown.end()
    assert status == 0, output
    report = flown.report()
    assert report["mode"] == "dual"
    assert report["engine"].startswith("openvino")
    assert report["action"]["predict_ms"]["p50"] > 0
    assert report["vision"]["encode_ms"]["p50"] > 0
    assert flown.relay.overrides == []
    assert "untrained" in output


def test_a_policy_without_a_fast_path_flies_single_rate_after_a_warning(tmp_path: Path) -> None:
    with flight(tmp_path) as flown:
        flags = ("--policy", "resnet-unet", "--allow-untrained", "--readonly", "--dual-rate")
        flown.start(*flags, "--duration", "3", "--max-feature-age", "2")
        status, output = flown.end()
    assert status == 0, output
    report = flown.report()
    assert report["mode"] == "single"
    assert report["action"]["target_hz"] == 30
    assert output.count("single-rate") >= 1
