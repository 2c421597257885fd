"""``mavbridge train``, from the command line to the checkpoint that flies."""

import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.flight_folders import write_meta, write_spot_flight
from mavbridge.__main__ import main
from mavbridge.commands.train.run import _ages, _settings
from mavbridge.config.train import TrainConfig
from mavbridge.core.errors import UserError
from mavbridge.core.stopping import INTERRUPTED
from policy.checkpoints.world_model_file import load_world_model
from policy.data.flight_folders import read_ages, read_flight
from policy.loading import PolicyRequest, load_policy
from policy.nets.toge import TogeConfig
from policy.training.loop import Loop

WORLD_MODEL = ["flights", "--out", "a.safetensors", "--policy", "world-model"]


def status_of(*arguments: str) -> int:
    with pytest.raises(SystemExit) as stopped:
        main(["train", *arguments])
    assert isinstance(stopped.value.code, int)
    return stopped.value.code


def trained(folder: Path, *asked: str, seconds: float) -> Path:
    """Train on two short flights, on one thread."""
    for seed in range(2):
        write_spot_flight(folder / "flights" / str(seed), seed, seconds=seconds)
    out = folder / "trained.safetensors"
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        status = status_of(str(folder / "flights"), "--out", str(out), *asked, "--batch-size", "4")
    finally:
        torch.set_num_threads(threads)
    assert status == 0
    return out


def test_a_checkpoint_is_trained_and_loads_to_fly(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--policy", "toge:small:resnet18", "--image-size", "32", "--steps", "3")
    out = trained(tmp_path, *asked, seconds=0.5)
    printed = capsys.readouterr()
    assert "held-out loss" in printed.out
    assert "stick error" in printed.out
    request = PolicyRequest(spec="toge", checkpoint=out, engine="torch", num_diffusion_steps=2)
    loaded = load_policy(request, now_s=lambda: 0.0)
    executable = loaded.executable
    assert executable.contract.since_exposure
    feature = executable.encode(np.zeros((48, 64, 3), np.uint8))
    state, history = np.zeros((1, 20), np.float32), np.zeros((1, 4, 4), np.float32)
    state[0, 3] = 1.0
    assert executable.act(feature, state, history, None).shape == (1, 16, 4)


def test_a_world_model_is_trained_by_the_same_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = ("--policy", "world-model", "--image-size", "32", "--steps", "2")
    out = trained(tmp_path, *asked, seconds=2.0)
    printed = capsys.readouterr()
    assert "imagined to" in printed.out
    model = load_world_model(out)
    assert model.config.image_size == 32
    assert model.config.contract.state_frame == "ned_frd"


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ([], "name the flights"),
        (["flights"], "name the checkpoint"),
        (["flights", "--out", "a.pt"], ".safetensors"),
        (["flights", "--out", "a.safetensors", "--policy", "scripted"], "cannot be trained"),
        (["flights", "--out", "a.safetensors", "--policy", "toge:huge"], "neither a size"),
        (["missing", "--out", "a.safetensors"], "no such folder"),
        (["foreign", "--out", "a.safetensors"], "not a flight of mavbridge"),
        (["flights", "--out", "a.safetensors", "--device", "cuda:9"], "not available"),
        (["flights", "--out", "a.safetensors", "--ages", "90:40"], "LOW:HIGH"),
        (["flights", "--out", "a.safetensors", "--steps", "1", "--minutes", "1"], "contradict"),
        (["flights", "--out", "a.safetensors", "--resume"], "no run to resume"),
        (["flights", "--out", "no/a.safetensors"], "no folder no"),
        (["flights", "--out", "a.safetensors", "--start-from", "b.safetensors"], "no such file"),
        (["flights", "--out", "a.safetensors", "--backbone-weights", "b.pth"], "not a readable"),
        ([*WORLD_MODEL, "--ages", "40:90"], "for policies"),
        ([*WORLD_MODEL, "--start-from", "b.safetensors"], "--freeze-encoder together"),
        ([*WORLD_MODEL, "--freeze-encoder"], "--freeze-encoder together"),
        ([*WORLD_MODEL, "--start-from", "b.safetensors", "--freeze-encoder"], "no such file"),
        ([*WORLD_MODEL, "--backbone-weights", "b.pth"], "for policies"),
        ([*WORLD_MODEL, "--image-size", "40"], "multiple of 16"),
        (WORLD_MODEL, "fly longer"),
    ],
)
def test_bad_input_is_one_message(
    arguments: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    write_spot_flight(tmp_path / "flights", 0, seconds=0.3)
    write_meta(tmp_path / "foreign", format="something else")
    assert status_of(*arguments) == 1
    printed = capsys.readouterr().err
    assert says in printed
    assert "Traceback" not in printed


def test_ctrl_c_keeps_the_run_and_says_how_it_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write_spot_flight(tmp_path / "flights" / "0", 0, seconds=0.5)
    command = (str(tmp_path / "flights"), "--out", str(tmp_path / "a.safetensors"))
    asked = ("--policy", "toge:small:resnet18", "--image-size", "32", "--batch-size", "4")
    step = Loop._step

    def step_and_interrupt(self: Loop[Any], phase_end: float) -> None:
        step(self, phase_end)
        if self.position.step == 1:
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(Loop, "_step", step_and_interrupt)
    assert status_of(*command, *asked, "--steps", "3") == INTERRUPTED
    assert "--resume" in capsys.readouterr().err
    assert status_of(*command, *asked, "--steps", "3", "--resume") == 0
    assert (tmp_path / "a.safetensors").is_file()


def test_ages_are_a_range_or_those_of_a_flight(tmp_path: Path) -> None:
    spread = _ages("40:90")
    assert (spread[0], spread[-1]) == (40_000_000, 90_000_000)
    folder = write_spot_flight(tmp_path / "a", 0, seconds=0.5)
    np.testing.assert_array_equal(_ages(str(folder)), read_ages(folder))
    with pytest.raises(UserError, match="LOW:HIGH"):
        _ages("few:many")


def test_the_policy_takes_the_frame_of_the_flights(tmp_path: Path) -> None:
    folder = write_spot_flight(tmp_path / "a", 0, seconds=0.3)
    write_meta(folder, contract={"state_frame": "enu_flu"})
    made = _settings(
        TrainConfig(since_exposure=False), tmp_path / "a.safetensors", [read_flight(folder)]
    )
    assert isinstance(made.policy, TogeConfig)
    assert made.policy.contract.state_frame == "enu_flu"
    assert not made.policy.contract.since_exposure
    assert made.budget.seconds == 45 * 60
