"""``mavbridge imagine`` from the command line."""

import os
import signal
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rerun.chunk import RrdReader

from helpers.recordings import make_meta
from helpers.rollouts import TINY, TinyWorld, read_rows, write_flight
from helpers.status import status_of
from mavbridge.commands.imagine import run
from mavbridge.commands.imagine.loop import Sampler
from mavbridge.recording.video.file import count_frames
from policy.checkpoints.networks import save_world_model
from policy.checkpoints.tensors import read_tensors, write_tensors
from policy.contract import Contract

Imagine = Callable[..., tuple[int, str]]
TOGE = (
    *("--decider", "toge", "--policy", "toge:small:resnet18"),
    *("--set-config", "network.allow_untrained=true", "--set-config", "network.image_size=32"),
    *("--set-config", "network.engine=torch", "--num-diffusion-steps", "2"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A flight, a world model, and things that are neither."""
    folder = tmp_path_factory.mktemp("imagine")
    write_flight(folder / "flight")
    write_flight(folder / "enu", meta=make_meta(contract=Contract(state_frame="enu_flu")))
    (folder / "empty").mkdir()
    (folder / "foreign").mkdir()
    (folder / "foreign" / "meta.json").write_text("{}")
    save_world_model(folder / "world.safetensors", TinyWorld())
    enu = replace(TINY, contract=Contract(state_frame="enu_flu"))
    save_world_model(folder / "enu.safetensors", TinyWorld(enu))
    broken = TinyWorld()
    for weight in broken.dynamics.parameters():
        weight.data.fill_(1e30)  # finite, and nothing that it makes is
    weights = {name: value.contiguous() for name, value in broken.state_dict().items()}
    header, _ = read_tensors(folder / "world.safetensors")
    write_tensors(folder / "broken.safetensors", weights, header)
    (folder / "taken.mp4").write_text("precious")
    return folder


@pytest.fixture
def imagine(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Imagine:
    """Exit status and output, from inside the folder."""
    monkeypatch.chdir(folder)

    def run(*flags: str) -> tuple[int, str]:
        defaults = {"--start": "flight", "--world-model": "world.safetensors", "--ddim-steps": "1"}
        given = [
            part for key, value in defaults.items() if key not in flags for part in (key, value)
        ]
        status = status_of("imagine", *given, *flags)
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        return status, " ".join((captured.out + captured.err).split())

    return run


def test_sampling_leaves_a_core_to_decoding(
    imagine: Imagine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    monkeypatch.setattr(torch, "get_num_threads", lambda: 8)
    monkeypatch.setattr(torch, "set_num_threads", asked.append)
    status, text = imagine("--out", str(tmp_path / "a.mp4"), "--n-iter", "1")
    assert status == 0, text
    assert asked[0] == 7
    assert asked[-1] == 8, "what it was before"


def test_without_a_video_there_are_rows_and_nothing_is_decoded(
    imagine: Imagine, tmp_path: Path
) -> None:
    out = tmp_path / "a.mp4"
    flags = ("--n-iter", "2", "--exe-steps", "16", "--no-decode-video")
    status, text = imagine("--out", str(out), *flags, "--fast-policy-no-decode")
    assert status == 0, text
    assert "32 rows, no video, 0 decoded" in text
    assert [path.name for path in tmp_path.iterdir()] == ["a.parquet"]
    assert read_rows(out).num_rows == 32


def test_rerun_shows_imagined_and_real_frames_states_and_sticks(
    imagine: Imagine, tmp_path: Path
) -> None:
    out, rrd = tmp_path / "a.mp4", tmp_path / "a.rrd"
    flags = ("--n-iter", "3", "--frames", "6", "--exe-steps", "6", "--rerun", str(rrd))
    status, text = imagine("--out", str(out), *flags)
    assert status == 0, text
    shown: dict[str, int] = {}
    for chunk in RrdReader(rrd).stream():
        if not chunk.is_static and not chunk.entity_path.startswith("/__"):
            rows = chunk.to_record_batch().num_rows
            shown[chunk.entity_path] = shown.get(chunk.entity_path, 0) + rows
    states = ("/state/velocity", "/state/attitude", "/state/rate", "/state/force")
    assert shown == dict.fromkeys(("/imagined", "/real", "/sticks", *states), 18)


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
    status, text = imagine("--out", str(out), "--n-iter", "1000", "--frames", "16")
    assert status == 130
    assert "interrupted" in text
    assert count_frames(out) == read_rows(out).num_rows == 48
    assert out.with_suffix(".parquet").exists()


def test_a_writer_that_dies_is_one_message_that_says_what_is_left(
    imagine: Imagine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, start_output = tmp_path / "a.mp4", run.StreamedOutput

    def start(*arguments: object, **named: object) -> object:
        made = start_output(*arguments, **named)  # type: ignore[arg-type]
        os.kill(made.video.pid, signal.SIGKILL)  # type: ignore[union-attr, arg-type]
        return made

    monkeypatch.setattr(run, "StreamedOutput", start)
    status, text = imagine("--out", str(out), "--n-iter", "100")
    assert status == 2
    assert "the writer process has died" in text
    assert "are readable" in text


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--exe-steps", "5", "--frames", "4"], "--exe-steps 5 is more than --frames 4"),
        (["--frames", "17"], "--frames 17 is more than the 16"),
        (["--exe-steps", "17"], "--exe-steps 17 is more than the 16"),
        (["--exe-steps", "0"], "exe-steps must be between 1 and 256"),
        (["--n-iter", "0"], "n-iter must be between 1"),
        (["--ddim-steps", "101"], "1..100"),
        (["--start", "nowhere"], "no folder nowhere"),
        (["--start", "empty"], "empty is empty"),
        (["--start", "foreign"], "is not of a recorded flight"),
        (["--start", "enu"], "states in enu_flu, the world model takes ned_frd"),
        (["--start-at", "5"], "too short"),
        (["--world-model", "none.safetensors"], "none.safetensors"),
        (["--world-model", "taken.mp4"], "taken.mp4"),
        (["--world-model", "broken.safetensors"], "imagined NaN or infinity"),
        (["--decider", "toge", "--policy", "toge:medium"], "--checkpoint"),
        (["--checkpoint", "a.safetensors"], "add --decider toge"),
        (["--decider", "pilot"], "pilot"),
        (["--start", "enu", "--world-model", "enu.safetensors", *TOGE], "enu_flu"),
        (["--device", "cuda:9"], "cuda:9 is not available"),
        (["--rerun", "a.txt"], ".rrd"),
        (["--out", "taken.mp4"], "taken.mp4 is there already"),
        (["--out", "a.avi"], "must end in .mp4"),
        (["--out", "taken.mp4/a.mp4"], "cannot write --out"),
    ],
)
def test_bad_input_is_one_message(
    imagine: Imagine, folder: Path, tmp_path: Path, flags: list[str], told: str
) -> None:
    out = () if "--out" in flags else ("--out", str(tmp_path / "a.mp4"))
    status, text = imagine(*flags, *out)
    assert status == 2
    assert told in text.replace("│ ", ""), text
    assert not (tmp_path / "a.mp4").exists()
    assert (folder / "taken.mp4").read_text() == "precious"
