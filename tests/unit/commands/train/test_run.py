"""``mavbridge train`` and ``train-world-model``, from the command line to the checkpoint."""

import signal
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest

from helpers.flight_folders import write_meta, write_spot_flight
from helpers.status import told_by
from mavbridge.commands import train as run
from mavbridge.core.stopping import INTERRUPTED
from policy.checkpoints.networks import load_world_model
from policy.contract import Contract
from policy.data.flight_data import FlightData
from policy.data.flight_folders import read_flight, read_flights
from policy.loading.builtin import SHIPPED
from policy.loading.load import load_policy
from policy.loading.request import PolicyRequest
from policy.nets.toge import TogeConfig
from policy.training.report import TrainingProgress
from policy.training.settings import TrainSettings

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = ("--policy", "toge:small:resnet8", "--image-size", "32", "--batch-size", "4")


def trained(folder: Path, command: str, *flags: str, seconds: float) -> tuple[Path, str]:
    """Train on two short flights; returns the checkpoint and what was printed."""
    for seed in range(2):
        write_spot_flight(folder / "flights" / str(seed), seed, seconds=seconds)
    out = folder / "trained.safetensors"
    status, text = told_by(command, folder / "flights", "--out", out, *flags)
    assert status == 0
    return out, text


def test_a_checkpoint_is_trained_and_loads_to_fly(tmp_path: Path) -> None:
    out, text = trained(tmp_path, "train", *SMALL, "--steps", "3", "--ages", "40:90", seconds=0.5)
    assert "held-out loss" in text
    assert "stick error" in text
    request = PolicyRequest(spec="toge", checkpoint=out, engine="torch", num_diffusion_steps=2)
    loaded = load_policy(request, now_s=lambda: 0.0)
    runner = loaded.runner
    assert runner.contract.since_exposure
    feature = runner.encode(np.zeros((48, 64, 3), np.uint8))
    state, history = np.zeros((1, 20), np.float32), np.zeros((1, 4, 4), np.float32)
    state[0, 3] = 1.0
    assert runner.act(feature, state, history).shape == (1, 16, 4)


def test_a_world_model_is_trained(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flown = Contract(full_lean_deg=45.0)
    monkeypatch.setattr(run, "common_contract", lambda flights: flown)
    flags = ("--image-size", "32", "--steps", "2")
    out, text = trained(tmp_path, "train-world-model", *flags, seconds=2.0)
    assert "imagined to" in text
    model = load_world_model(out)
    assert model.config.image_size == 32
    assert model.config.contract == flown


def test_cameras_of_different_names_are_told(tmp_path: Path) -> None:
    write_spot_flight(tmp_path / "flights" / "a", 0, seconds=0.5)
    down = write_spot_flight(tmp_path / "flights" / "b", 1, seconds=0.5)
    write_meta(down, contract=asdict(Contract(cameras=("down",))))
    out = ("--out", tmp_path / "a.safetensors")
    status, text = told_by("train", tmp_path / "flights", *out, *SMALL, "--steps", "1")
    assert (status, "cameras down, front are taken for one" in text) == (0, True)


def test_the_end_is_not_learned_from_flights_without_gates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    flights, out = tmp_path / "flights", tmp_path / "a.safetensors"
    for seed, name in enumerate(("blind", "sighted")):
        write_spot_flight(flights / name, seed, seconds=0.3)

    def read(folders: Sequence[Path], camera: str | None) -> tuple[list[FlightData], list[str]]:
        (blind, sighted), left_out = read_flights(folders, camera)
        return [replace(blind, gate=np.full_like(blind.gate, np.nan)), sighted], left_out

    monkeypatch.setattr(run, "read_flights", read)
    start = ("--start-from", SHIPPED, "--only-end")
    status, text = told_by("train", flights, "--out", out, *start, *SMALL)
    assert status == 2
    assert "say where the gates were" in text
    assert "blind does not" in text
    assert not out.exists()


def test_ctrl_c_keeps_the_best_weights_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_spot_flight(tmp_path / "flights" / "0", 0, seconds=0.5)
    out = tmp_path / "a.safetensors"

    def interrupt(_bar: object, _task: object, progress: TrainingProgress) -> None:
        if progress.stage.startswith("encoding"):
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(run, "_show", interrupt)
    status, text = told_by("train", tmp_path / "flights", "--out", out, *SMALL, "--steps", "8")
    assert status == INTERRUPTED
    assert "holds the best weights so far" in text
    assert out.is_file()


def test_a_dataset_that_is_named_twice_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its episodes would be both learned from and held out."""
    (tmp_path / "set" / "meta").mkdir(parents=True)
    (tmp_path / "set" / "meta" / "info.json").write_text("{}")
    (tmp_path / "link").symlink_to(tmp_path / "set")
    monkeypatch.setattr(run, "read_dataset", lambda path, _key: [path])
    named = [tmp_path / "set", tmp_path / "link", tmp_path / "set" / ".." / "set"]
    asked = TrainSettings(out=tmp_path / "a.safetensors")
    assert run._read_flights(named, asked) == [(tmp_path / "set").resolve()]


def test_the_policy_takes_frame_and_sticks_of_the_flights(tmp_path: Path) -> None:
    folder = write_spot_flight(tmp_path / "a", 0, seconds=0.3)
    sticks = {"modes": ["LOITER"], "full_lean_deg": 45.0, "throttle_dead_zone": 0.0}
    write_meta(folder, contract={"state_frame": "enu_flu", **sticks})
    settings = TrainSettings(out=tmp_path / "a.safetensors", since_exposure=False)
    network = TogeConfig(backbone="resnet8", contract=Contract(since_exposure=True))
    made = run.fit_to_flights(network, [read_flight(folder)], settings)
    assert made.contract.state_frame == "enu_flu"
    assert made.contract.modes == ("LOITER",)
    assert (made.contract.full_lean_deg, made.contract.throttle_dead_zone) == (45.0, 0.0)
    assert not made.contract.since_exposure
