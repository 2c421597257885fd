import importlib.util
from pathlib import Path

import pytest

from mavbridge.commands.output import print_status, require_outputs
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


def test_a_figure_without_matplotlib_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"--plot needs matplotlib: pip install"):
        require_outputs(None, tmp_path / "a.png")


def test_what_is_being_done_is_told_without_passwords(capsys: pytest.CaptureFixture[str]) -> None:
    print_status("opening rtsp://me:it@host/1?token=abc")
    assert capsys.readouterr().err == "opening rtsp://me:***@host/1?token=***\n"
