"""What comes with mavbridge: the world model, and the flight under ``examples`` to start from."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from helpers.rollouts import read_rows
from helpers.status import status_of
from mavbridge.commands.imagine.run import SHIPPED
from mavbridge.recording.flight_folder import open_flight
from mavbridge.recording.video.file import read_video
from policy.checkpoints.networks import load_world_model
from policy.preprocess import resize

ROOT = Path(__file__).parents[4]
START = ROOT / "examples" / "start"


@pytest.mark.parametrize(
    "decider",
    [("--decider", "world-model"), ("--decider", "toge", "--dual-rate")],
    ids=["world-model", "toge"],
)
def test_the_documented_command_imagines_what_might_come(
    decider: tuple[str, ...], tmp_path: Path
) -> None:
    out = tmp_path / "rollout.mp4"
    flags = ("--n-iter", "2", "--exe-steps", "8", "--out", str(out), *decider)
    assert status_of("imagine", "--start", START, *flags) == 0
    rows, frames = read_rows(out), list(read_video(out))
    assert rows.num_rows == len(frames) == 16
    first_seen = resize(next(iter(open_flight(START).images())), 64, 64)
    assert cv2.PSNR(frames[0], first_seen) > 15  # a tenth of a second on: the same place
    speed_mps = np.linalg.norm(np.array(rows["state"].to_pylist())[:, :3], axis=1)
    assert speed_mps.max() < 15


def test_the_weights_are_small_enough_to_come_with_the_code() -> None:
    assert SHIPPED.stat().st_size < 4_000_000
    assert load_world_model(SHIPPED).config.contract.state_frame == "ned_frd"
