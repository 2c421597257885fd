"""A policy with two cameras, in real processes."""

from pathlib import Path

import pytest

from mavbridge.recording.flight_folder import open_flight
from sitl.faults.stage.stage import faulty_policy, staged

pytestmark = pytest.mark.system

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm")


def test_two_cameras_feed_one_policy(tmp_path: Path) -> None:
    with staged(tmp_path) as flying:
        flying.cameras = ("down", "front")  # their order is the contract's, not this one
        folder = tmp_path / "recording"
        flags = ("--policy", faulty_policy("TwoEyed"), "--duration", "4")
        status, output = flying.fly(*FLY, *flags, "--record", str(folder))
    assert status == 0, output
    front, down = open_flight(folder), open_flight(folder, "down")
    assert front.meta.finished
    assert front.meta.frames == front.frames.num_rows == sum(1 for _ in front.images())
    assert 0 < down.frames.num_rows == sum(1 for _ in down.images())
    assert down.frames.num_rows < 0.7 * front.frames.num_rows  # 15 images a second, not 30
    assert flying.vehicle_report()["max_altitude_m"] > 0.3
    assert flying.report()["vision"]["frames"] > 0


def test_a_fault_of_the_second_camera_ends_the_flight(tmp_path: Path) -> None:
    with staged(tmp_path) as flying:
        flying.cameras = ("front", "down")
        status, output = flying.fly(*FLY, "--policy", faulty_policy("HangingBelow"))
    assert status == 4
    assert "the image feature is older than 300 ms" in output
    assert "the encoder of camera down has hung" in output
    assert "Traceback" not in output


def test_a_camera_without_its_name_is_refused(tmp_path: Path) -> None:
    with staged(tmp_path) as flying:
        status, output = flying.fly(*FLY, "--policy", faulty_policy("TwoEyed"))
    assert status == 2, output
    assert "give --camera front=SOURCE --camera down=SOURCE" in output
    assert flying.relay.overrides == []
