import importlib.util
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console

from mavbridge.commands.output import print_status, progress_bar, require_matplotlib
from mavbridge.core.errors import UserError
from mavbridge.core.files import require_writable


def test_a_folder_is_made_for_the_output_and_the_output_is_not(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.json"
    require_writable(path, "--json")
    assert path.parent.is_dir()
    assert not path.exists()


@pytest.mark.parametrize("name", ["", "file/a.json"])
def test_what_cannot_be_written_is_refused_with_its_flag(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"cannot write --json .*: "):
        require_writable(tmp_path / name, "--json")


def test_a_figure_without_matplotlib_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"--plot needs matplotlib: pip install"):
        require_matplotlib()


def test_what_is_being_done_is_told_without_passwords(capsys: pytest.CaptureFixture[str]) -> None:
    print_status("opening rtsp://me:it@host/1?token=abc")
    assert capsys.readouterr().err == "opening rtsp://me:***@host/1?token=***\n"


@pytest.mark.parametrize(("as_percentage", "count"), [(False, "2/8"), (True, "25%")])
def test_progress_shows_count_and_status(as_percentage: bool, count: str) -> None:
    text = StringIO()
    console = Console(file=text, width=120)
    with progress_bar(console, as_percentage=as_percentage) as progress:
        progress.add_task("flying", total=8, completed=2, status="1 of 2 finished")
    for part in ("flying", count, "1 of 2 finished"):
        assert part in text.getvalue()
