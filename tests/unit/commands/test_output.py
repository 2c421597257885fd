import importlib.util
from pathlib import Path

import pytest

from mavbridge.commands.output import print_status, require_outputs
from mavbridge.core.errors import UserError


def test_a_figure_without_matplotlib_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"--plot needs matplotlib: pip install"):
        require_outputs(None, tmp_path / "a.png")


def test_what_is_being_done_is_told_without_passwords(capsys: pytest.CaptureFixture[str]) -> None:
    print_status("opening rtsp://me:it@host/1?token=abc")
    assert capsys.readouterr().err == "opening rtsp://me:***@host/1?token=***\n"
