import importlib.util
from pathlib import Path

import pytest
from rich.text import Text

from mavbridge.commands.output import make_table, print_status, require_outputs, text_console
from mavbridge.core.errors import MavbridgeError


def test_a_figure_without_matplotlib_is_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with pytest.raises(MavbridgeError, match=r"--plot needs matplotlib: pip install"):
        require_outputs(None, tmp_path / "a.png")


def test_a_text_of_others_cannot_steer_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    console, hostile = text_console(), "a\x1b]52;c;eA==\x9b2J\u202eb\x7f"
    console.print(make_table(hostile, [hostile], [[hostile]]))
    console.print(hostile, style="red")
    console.print(Text(hostile))
    shown = capsys.readouterr().out
    assert shown.count("a\ufffd]52;c;eA==\ufffd2J\ufffdb\ufffd\n") == 2
    assert not set("\x1b\x9b\u202e\x7f") & set(shown)


def test_what_is_being_done_is_told_without_passwords(capsys: pytest.CaptureFixture[str]) -> None:
    print_status("opening rtsp://me:it@host/1?token=abc")
    assert capsys.readouterr().err == "opening rtsp://me:***@host/1?token=***\n"
