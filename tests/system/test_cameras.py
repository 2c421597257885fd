"""Two cameras and cameras of depth, in real processes."""

import os
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest

from faults.stage import faulty_policy, staged
from helpers.camera_senders import (
    SIDE,
    depth_scene,
    repeating,
)
from helpers.status import printed_by
from mavbridge.core.clock import MonotonicClock
from mavbridge.recording.flight_folder import open_flight
from policy.errors import DatasetError
from sitl.camera.shm import FramePublisher

FLY = ("--dual-rate", "--mode", "ALT_HOLD", "--arm")


def test_two_cameras_feed_one_policy(tmp_path: Path) -> None:
    with staged(tmp_path, renders=False) as flying:
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
    with staged(tmp_path, renders=False) as flying:
        flying.cameras = ("front", "down")
        status, output = flying.fly(*FLY, "--policy", faulty_policy("HangingBelow"))
    assert status == 4
    assert re.search(r"the image is \d+ ms old, beyond 300 ms", output)
    assert "the encoder of camera down has hung" in output
    assert "Traceback" not in output


@pytest.fixture
def depth_policy(tmp_path: Path) -> str:
    path = tmp_path / "deep.py"
    path.write_text(
        "import numpy as np\n"
        "from policy.contract import Contract\n\n\n"
        "class Deep:\n"
        "    contract = Contract(\n"
        "        arrays='numpy', image_channels='depth', image_height=32, image_width=32\n"
        "    )\n\n"
        "    def predict(self, image, state, history, steps):\n"
        "        assert image.shape == (1, 1, 32, 32)\n"
        "        assert 1.0 < image.max() < 12.0, image.max()\n"
        "        chunk = np.zeros((1, 16, 4), np.float32)\n"
        "        chunk[..., 0] = 0.5\n"
        "        return chunk\n"
    )
    return f"{path}:Deep"


@contextmanager
def depth_camera() -> Iterator[str]:
    """The name of a shared memory with images of depth, at 30 Hz while the context lasts."""
    name, clock = f"mb-test-depth-{os.getpid()}", MonotonicClock()
    with (
        closing(FramePublisher(name, SIDE, SIDE, is_depth=True)) as publisher,
        repeating(lambda number: publisher.publish(depth_scene(number), clock.now_ns())),
    ):
        yield name


def test_a_depth_policy_is_flown_and_recorded_and_refused_with_a_camera_of_colour(
    tmp_path: Path, depth_policy: str
) -> None:
    fly = (*FLY, "--policy", depth_policy)
    with staged(tmp_path, renders=False) as flying, depth_camera() as name:
        status, output = flying.fly(*fly)
        assert status == 2, output
        assert "delivers RGB images of" in output
        assert flying.relay.overrides == []
        flying._shm = name
        folder = tmp_path / "recording"
        status, output = flying.fly(*fly, "--duration", "3", "--record", str(folder))
    assert status == 0, output
    report = flying.report()
    assert (report["mode"], report["action"]["target_hz"]) == ("single", 30)
    assert "single-rate" in output  # it has no fast path
    recorded = open_flight(folder)
    images = list(recorded.images())
    assert recorded.meta.finished
    assert len(images) == recorded.frames.num_rows > 30
    for image in images:
        assert np.array_equal(image, depth_scene(int(image[0, 20]) - 2020))
    with pytest.raises(DatasetError, match="holds depth"):
        next(recorded.rgb_images())
    status, output = printed_by("replay", str(folder), "--policy", depth_policy)
    assert status == 0, output
