"""A console that nobody reads holds up neither a flight nor its end.

Whole flights of such a console are in tests/faults/catalogue: terminal-stalled, chatty-unread.
"""

import io
import os
import sys

import pytest
from rich.console import Console

from helpers.factories import make_tick
from helpers.reports import report_of
from mavbridge.observe.output import PatientOutput, stray_lines_shown
from mavbridge.observe.terminal import FlightScreen


def test_a_reader_who_comes_back_gets_everything() -> None:
    reader, writer = os.pipe()
    with os.fdopen(writer, "w") as stream, os.fdopen(reader) as lines:
        console = Console(file=PatientOutput(stream), width=80)  # type: ignore[arg-type]
        screen = FlightScreen(console, action_hz=100, vision_hz=30, readonly=False)
        screen.start()
        texts = [f"message {number:2d} " * 200 for number in range(90)]  # more than a pipe holds
        for text in texts:
            screen.show_message(text)
        assert [lines.readline().rstrip("\n") for _ in texts] == texts
        screen.show_report(report_of(make_tick(0)))
        assert screen.close(60.0)


def test_a_reader_who_is_gone_is_written_to_no_more() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        output = PatientOutput(stream)
        output.write("to nobody")
        output.flush()
        output.write("to nobody")
        output.flush()
        assert output.fileno() == writer
        assert not output.isatty()


def test_what_anybody_prints_becomes_messages(monkeypatch: pytest.MonkeyPatch) -> None:
    shown: list[str] = []
    errors, out = io.StringIO(), io.StringIO()
    monkeypatch.setattr(sys, "stderr", errors)
    monkeypatch.setattr(sys, "stdout", out)
    with stray_lines_shown(shown.append):
        sys.stderr.write("one\ntw")
        sys.stderr.write("o\r\n" + 3000 * "x")
        print("to a file")
        sys.stderr.write("its last words")
        kept = sys.stderr
    print("afterwards", file=kept, flush=True)
    assert shown.pop() == "afterwards"
    assert shown == ["one", "two", 3000 * "x", "its last words"]
    assert sys.stderr is errors
    assert out.getvalue() == "to a file\n"
