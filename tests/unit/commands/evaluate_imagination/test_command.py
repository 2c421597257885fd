"""``mavbridge evaluate-imagination`` from the command line."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from helpers.recordings import make_meta
from helpers.rollouts import TinyWorld, write_flight
from mavbridge.__main__ import main
from mavbridge.commands.evaluate_imagination import run
from mavbridge.commands.evaluate_imagination.flights import read_episode
from mavbridge.commands.imagine.sampling import Sampler
from policy.checkpoints.world_model_file import save_world_model
from policy.contract import Contract

Evaluate = Callable[..., tuple[int, str]]
QUICK = ("--world-model", "world.safetensors", "--ddim-steps", "1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Flights, a world model, and things that are neither."""
    folder = tmp_path_factory.mktemp("evaluate")
    for name, seconds in (("a", 4.0), ("b", 4.0), ("short", 1.0)):
        write_flight(folder / "flights" / name, seconds=seconds)
    failed = make_meta(source="demonstration", success=False)
    write_flight(folder / "flights" / "failed", meta=failed)
    enu = make_meta(contract=Contract(state_frame="enu_flu"))
    write_flight(folder / "enu", seconds=3.0, meta=enu)
    (folder / "empty").mkdir()
    save_world_model(folder / "world.safetensors", TinyWorld(), half=False)
    broken = TinyWorld()
    for weight in broken.dynamics.parameters():
        weight.data.fill_(1e30)  # finite, and nothing that it makes is
    save_world_model(folder / "broken.safetensors", broken, half=False)
    return folder


@pytest.fixture
def evaluate(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Evaluate:
    """Exit status and output, from inside the folder."""
    monkeypatch.chdir(folder)

    def evaluated(*arguments: str) -> tuple[int, str]:
        with pytest.raises(SystemExit) as stopped:
            main(["evaluate-imagination", *arguments])
        captured = capsys.readouterr()
        assert "Traceback" not in captured.err
        assert isinstance(stopped.value.code, int)
        return stopped.value.code, " ".join((captured.out + captured.err).split())

    return evaluated


@pytest.mark.usefixtures("evaluate")
def test_the_old_spelling_still_works_and_names_the_new_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    counts = ("--windows", "2", "--chains", "1")
    with pytest.raises(SystemExit) as stopped:
        main(["imagine", "flights", *QUICK, *counts, "--evaluate"])
    captured = capsys.readouterr()
    assert stopped.value.code == 0, captured.err
    assert "action swap" in captured.out
    assert captured.err.count("evaluate-imagination") == 1


def test_everything_is_printed_and_written(evaluate: Evaluate, tmp_path: Path) -> None:
    out = tmp_path / "new" / "quality.json"
    flags = ("--windows", "4", "--chains", "2", "--exe-steps", "4", "--json", str(out))
    status, text = evaluate("flights", *QUICK, *flags)
    assert status == 0, text
    assert "4 windows of 2 flights" in text
    assert "1 too short, 1 demonstrations that failed" in text
    for what in ("copy last", "sticks swapped", "action swap", "drift"):
        assert what in text
    written = json.loads(out.read_text())
    assert written["windows"] == 4
    assert written["given"]["flights"] == 2
    assert [row["step"] for row in written["frames"]] == [1, 4, 8, 16] * 3
    assert [row["pairs"] for row in written["stick_following"]] == [16] * 6
    assert written["own_actions_nearer"]["count"] == 4
    # 4 s hold 40 frames: 2 + 16 + 4 (n - 1) of them for n = 6 iterations.
    assert [row["chains"] for row in written["drift"]] == [2] * 6


def test_the_same_seed_gives_the_same_figures_and_another_one_does_not(
    evaluate: Evaluate, tmp_path: Path
) -> None:
    written = []
    for name, seed in (("a", "5"), ("b", "5"), ("c", "6")):
        out = tmp_path / name
        flags = ("--windows", "1", "--chains", "1", "--seed", seed, "--json", str(out))
        assert evaluate("flights/a", *QUICK, *flags)[0] == 0
        written.append(out.read_text())
    assert written[0] == written[1]
    assert json.loads(written[0])["frames"] != json.loads(written[2])["frames"]
    assert json.loads(written[0])["own_actions_nearer"] is None  # one window cannot be swapped


def test_ctrl_c_reports_what_there_is(
    evaluate: Evaluate, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, calls = tmp_path / "quality.json", []
    sample = Sampler.sample

    def interrupted(self: Sampler, *arguments: object, **named: object) -> object:
        calls.append(arguments)
        if len(calls) == 3:  # in the second window, of two samples each
            os.kill(os.getpid(), signal.SIGINT)
        return sample(self, *arguments, **named)  # type: ignore[arg-type]

    monkeypatch.setattr(Sampler, "sample", interrupted)
    status, text = evaluate("flights", *QUICK, "--windows", "50", "--json", str(out))
    assert status == 130
    assert "interrupted" in text
    written = json.loads(out.read_text())
    assert written["windows"] == 2
    assert written["drift"] == []


def test_ctrl_c_before_the_first_window_is_no_error(
    evaluate: Evaluate, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*arguments: object) -> object:
        os.kill(os.getpid(), signal.SIGINT)
        return read_episode(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(run, "read_episode", interrupted)
    status, text = evaluate("flights/short", "flights/a", *QUICK)
    assert status == 130, text
    assert "0 windows of 0 flights" in text


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "name the flights"),
        (["nowhere"], "nowhere: no such folder"),
        (["empty"], "empty: neither a flight"),
        (["flights/short"], "no flight is long enough: 1 are too short"),
        (["flights/failed"], "no flight is long enough"),
        (["enu"], "states in enu_flu, the world model takes ned_frd"),
        (["flights/a", "--exe-steps", "17"], "--exe-steps 17 is more than the 16"),
        (["flights/a", "--windows", "0"], "windows must be between 1"),
        (["flights/a", "--chains", "0"], "chains must be between 1"),
        (["flights/a", "--ddim-steps", "101"], "1..100"),
        (["flights/a", "--world-model", "none.safetensors"], "none.safetensors"),
        (["flights/a", "--world-model", "broken.safetensors"], "imagined NaN or infinity"),
        (["flights/a", "--device", "cuda:9"], "cuda:9 is not available"),
        (["flights/a", "--json", "empty"], "cannot write --json empty"),
    ],
)
def test_bad_input_is_one_message(evaluate: Evaluate, arguments: list[str], told: str) -> None:
    defaults = {"--world-model": "world.safetensors", "--ddim-steps": "1", "--windows": "2"}
    given = [
        part for key, value in defaults.items() if key not in arguments for part in (key, value)
    ]
    status, text = evaluate(*arguments, *given)
    assert status == 2
    assert told in text, text


@pytest.mark.parametrize("flag", ["--start", "--out", "--decider"])
def test_what_is_for_a_rollout_is_refused(evaluate: Evaluate, flag: str) -> None:
    status, text = evaluate("flights/a", *QUICK, flag, "toge")
    assert status == 2  # of the parser
    assert f'Unknown option: "{flag}"' in text or f"Unknown option: {flag}" in text
