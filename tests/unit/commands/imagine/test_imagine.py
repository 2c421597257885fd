"""``mavbridge imagine`` from the command line, and what ships with it."""

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from helpers.recordings import count_frames, read_video
from helpers.rollouts import TinyWorld, read_rows, write_flight
from helpers.status import status_of, told_by
from mavbridge.commands.imagine import SHIPPED, StreamedOutput
from mavbridge.commands.imagine_rollout import PolicyDecider, Sampler
from mavbridge.recording.flight_folder import open_flight
from policy.checkpoints.networks import load_world_model, save_world_model
from policy.preprocess import resize

Imagine = Callable[..., tuple[int, str]]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("imagine")
    write_flight(folder / "flight")
    save_world_model(folder / "world.safetensors", TinyWorld())
    return folder


@pytest.fixture
def imagine(folder: Path, tmp_path: Path) -> Imagine:
    """Imagine into ``a.mp4``; returns exit status and output."""
    given = ("--start", folder / "flight", "--world-model", folder / "world.safetensors")
    return partial(told_by, "imagine", *given, "--out", tmp_path / "a.mp4", "--ddim-steps", "1")


def test_without_a_video_there_are_rows_and_nothing_is_decoded(
    imagine: Imagine, tmp_path: Path
) -> None:
    flags = ("--n-iter", "2", "--exe-steps", "16", "--no-decode-video", "--fast-policy-no-decode")
    status, text = imagine(*flags)
    assert status == 0, text
    assert "32 rows, no video" in text
    assert [path.name for path in tmp_path.iterdir()] == ["a.parquet"]
    assert read_rows(tmp_path / "a.mp4").num_rows == 32


def test_ctrl_c_finishes_what_is_there(
    imagine: Imagine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, simulated = tmp_path / "a.mp4", []
    sample = Sampler.sample

    def interrupted(self: Sampler, *arguments: object, **named: object) -> object:
        simulated.append(arguments)
        if len(simulated) == 5:  # in the decision of the third iteration
            os.kill(os.getpid(), signal.SIGINT)
        return sample(self, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(Sampler, "sample", interrupted)
    status, text = imagine("--n-iter", "1000", "--frames", "16")
    assert status == 130
    assert "interrupted" in text
    assert count_frames(out) == read_rows(out).num_rows == 48
    assert out.with_suffix(".parquet").exists()


def test_a_writer_that_dies_is_one_message_that_says_what_is_left(
    imagine: Imagine, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(*arguments: object, **named: object) -> object:
        made = StreamedOutput(*arguments, **named)  # type: ignore[arg-type]
        os.kill(made.video._process.pid, signal.SIGKILL)  # type: ignore[union-attr, arg-type]
        return made

    monkeypatch.setattr("mavbridge.commands.imagine.StreamedOutput", start)
    status, text = imagine("--n-iter", "100")
    assert status == 2
    assert "the writer process has died" in text
    left = text.split("is readable in ")[1].split()[::2]
    assert left[-1].endswith("a.arrows")
    assert all(Path(name).exists() for name in left)


@pytest.mark.parametrize("rate", ["--single-rate", "--dual-rate"])
def test_the_rate_is_obeyed(imagine: Imagine, monkeypatch: pytest.MonkeyPatch, rate: str) -> None:
    flown: list[bool] = []
    decide = PolicyDecider.decide

    def seen(self: PolicyDecider, *arguments: Any) -> Any:
        flown.append(self._runner.dual_rate)
        return decide(self, *arguments)

    monkeypatch.setattr(PolicyDecider, "decide", seen)
    status, text = imagine("--decider", "toge", "--policy", "scripted", "--n-iter", "1", rate)
    assert status == 0, text
    assert flown == [rate == "--dual-rate"]


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
