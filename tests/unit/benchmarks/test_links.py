from pathlib import Path

import pytest

from benchmarks import links
from helpers.bench_results import make_link
from mavbridge.commands.bench.link import LinkClient
from mavbridge.commands.bench.results import LinkLatency
from mavbridge.core.errors import UserError


def make_checkout(folder: Path) -> Path:
    python = folder / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.touch()
    return folder


def test_every_client_has_its_turn_in_each_round(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    timed: list[str] = []

    def time_link(client: LinkClient, attitudes: int) -> LinkLatency:
        timed.append(client.name)
        return make_link(client.name, round_trip_ms=attitudes, chunk_to_wire_ms=None)

    monkeypatch.setattr(links, "time_link", time_link)
    links.main(attitudes=25, rounds=2, before=make_checkout(tmp_path))
    assert timed[:3] == ["mavbridge", "mavbridge before", "bare pymavlink loop"]
    assert timed == timed[: len(timed) // 2] * 2
    assert capsys.readouterr().out.count("25.00 / 25.00") == len(timed)


def test_an_earlier_checkout_runs_by_its_own_interpreter_and_modules(tmp_path: Path) -> None:
    client = links.earlier_client(make_checkout(tmp_path))
    assert f"PYTHONPATH={tmp_path}" in client.command
    assert str(tmp_path / ".venv" / "bin" / "python") in client.command


def test_a_folder_without_an_environment_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="install it there"):
        links.earlier_client(tmp_path)
