"""Training of what ships: its commands are ours, and what is done is not done again."""

from pathlib import Path

import pytest

from benchmarks import train_shipped
from benchmarks.train_shipped import STEPS
from mavbridge.cli import cli
from mavbridge.config.settings_files import with_settings


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    run: list[str] = []

    def remember(folder: Path, command: str) -> None:
        run.append(command)
        if command.startswith("train"):
            (folder / command.partition("--out ")[2].split()[0]).touch()

    monkeypatch.setattr(train_shipped, "run", remember)

    def teach(before: Path, *, out: Path, minutes: float) -> None:
        assert before.exists()
        out.touch()

    monkeypatch.setattr(train_shipped.teach_looks, "main", teach)
    return run


@pytest.mark.parametrize("policy", list(STEPS))
def test_every_command_is_one_of_ours(
    policy: str, commands: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    train_shipped.main(policy, out=tmp_path)  # type: ignore[arg-type]
    assert len(commands) == len(STEPS[policy])
    assert (tmp_path / policy / f"{policy}.safetensors").exists()
    monkeypatch.chdir(tmp_path / policy)
    for command in commands:
        _, outer, _ = cli.meta.parse_args(command.split(), print_error=False, exit_on_error=False)
        words = with_settings(outer.args, outer.arguments.get("set_config", ()))
        cli.parse_args(words, print_error=False, exit_on_error=False)


def test_weights_that_are_there_are_not_trained_again(commands: list[str], tmp_path: Path) -> None:
    (tmp_path / "toge").mkdir()
    for weights in ("zeroth", "before", "first", "second", "third", "toge"):
        (tmp_path / "toge" / f"{weights}.safetensors").touch()
    train_shipped.main("toge", out=tmp_path)
    assert not [command for command in commands if command.startswith("train")]
