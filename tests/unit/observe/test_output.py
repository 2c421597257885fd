"""A console that nobody reads holds up neither a flight nor its end.

Whole flights of such a console are in tests/faults/catalogue: terminal-stalled, chatty-unread.
"""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from helpers.factories import make_tick
from helpers.reports import report_of
from mavbridge.core.processes import child_environment
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
        screen.close(60.0)


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


@pytest.mark.parametrize("console", ["stdout", "stderr", "both"])
def test_what_is_printed_to_the_file_of_the_console_becomes_messages(
    console: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shown: list[str] = []
    with (tmp_path / "out").open("w") as out, (tmp_path / "err").open("w") as errors:
        streams = {"stdout": out, "stderr": out if console == "both" else errors}
        for name, stream in streams.items():
            monkeypatch.setattr(sys, name, stream)
        with stray_lines_shown(shown.append, streams.get(console, out)):
            kept = getattr(sys, "stderr" if console == "both" else console)
            kept.write("one\ntw")
            kept.write("o\r\n" + 3000 * "x")
            for name in streams:
                print(f"to {name}", file=getattr(sys, name))
            kept.write("its last words")
        print("afterwards", file=kept, flush=True)
        assert {name: getattr(sys, name) for name in streams} == streams
    others = [name for name in streams if console not in (name, "both")]
    own = [f"to {name}" for name in streams if name not in others]
    assert shown == ["one", "two", 3000 * "x", *own, "its last words", "afterwards"]
    elsewhere = (tmp_path / "out").read_text() + (tmp_path / "err").read_text()
    assert elsewhere == "".join(f"to {name}\n" for name in others)


def test_a_stream_of_a_policy_that_is_no_file_keeps_its_lines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[str] = []
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(write=kept.append, flush=lambda: None))
    with (tmp_path / "console").open("w") as console, stray_lines_shown(pytest.fail, console):
        print("mine")
    assert kept == ["mine", "\n"]


@pytest.mark.parametrize("closed", ["<&- >&- 2>&-", ">&-", "2>&-"])
def test_a_file_does_not_take_the_place_of_a_closed_stream(closed: str, tmp_path: Path) -> None:
    """The guard would get the null device in place of its channel, and the log would be empty."""
    code = "import os, sys; from mavbridge.__main__ import open_closed_streams as open_them; "
    code += "open_them(); file = open('number', 'w'); file.write(str(file.fileno())); "
    code += "from mavbridge.observe.output import survive_lost_readers; survive_lost_readers(); "
    code += "print('out', file=sys.stdout, flush=True); print('err', file=sys.stderr, flush=True); "
    code += "sys.exit(any(not os.get_inheritable(stream) for stream in range(3)))"
    command = ["sh", "-c", f'exec "$@" {closed}', "sh", sys.executable, "-c", code]
    subprocess.run(command, cwd=tmp_path, env=child_environment(), check=True)
    assert int((tmp_path / "number").read_text()) > 2


def test_a_full_disk_under_an_output_is_told_and_fails_nobody_who_prints() -> None:
    code = "from mavbridge.observe.output import survive_lost_readers; survive_lost_readers(); "
    code += "print('lost'); print('on')"
    command = ["sh", "-c", 'exec "$@" >/dev/full', "sh", sys.executable, "-c", code]
    ended = subprocess.run(command, env=child_environment(), capture_output=True, check=True)
    assert ended.stderr == b"warning: the output is cut short: No space left on device\n"
