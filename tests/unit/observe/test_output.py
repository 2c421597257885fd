"""A console that nobody reads holds up neither a flight nor its end."""

import io
import os
import pty
import select
import signal
import subprocess
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

import pytest
from rich.console import Console

from helpers.factories import make_tick
from helpers.reports import report_of
from mavbridge.observe.output import PatientOutput, stray_lines_shown
from mavbridge.observe.terminal import FlightScreen

FLIGHT = """
import logging, sys, threading
from helpers.factories import make_tick
from helpers.reports import report_of
from mavbridge.core.errors import MavbridgeError
from mavbridge.core.stopping import end_process, stop_on_signals
from mavbridge.observe.output import flight_console
from mavbridge.observe.terminal import FlightScreen

screen = FlightScreen(flight_console(), action_hz=100, vision_hz=30, readonly=False)
with stop_on_signals() as stop:
    screen.start()
    index = 0
    print("flying", file=open(sys.argv[1], "w"))
    while not stop.wait(0.001):
        index += 1
        screen.emit(make_tick(index, texts=("a message of the vehicle " * 40,)))
        logging.warning("a warning " * 40)
        sys.stderr.write("stray text " * 40)
screen.show_report(report_of(make_tick(0)))
is_read = screen.close(0.3)
end_process(3 if is_read else 4, lambda: print("error: the end", file=sys.stderr))
"""


@contextmanager
def stalled_pipe() -> Iterator[int]:
    reader, writer = os.pipe()
    yield writer
    os.close(reader)
    os.close(writer)


@contextmanager
def stopped_terminal() -> Iterator[int]:
    master, terminal = pty.openpty()
    termios.tcflow(terminal, termios.TCOOFF)  # as Ctrl-S does
    yield terminal
    os.close(master)
    os.close(terminal)


@pytest.mark.parametrize("console", [stalled_pipe, stopped_terminal])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_the_flight_of_a_console_that_nobody_reads(
    console: Callable[[], AbstractContextManager[int]], number: signal.Signals, tmp_path: Path
) -> None:
    """Fails with a plain ``Console(stderr=True)``, and with ``sys.exit`` for ``end_process``."""
    fifo = tmp_path / "flying"
    os.mkfifo(fifo)
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"} | {
        "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)
    }
    with console() as stderr:
        command = [sys.executable, "-c", FLIGHT, str(fifo)]
        with subprocess.Popen(command, stderr=stderr, env=environment) as flight:
            assert fifo.read_text() == "flying\n"
            assert wait_until_full(stderr)
            flight.send_signal(number)
            try:
                assert flight.wait(30.0) == 4
            finally:
                flight.kill()


def wait_until_full(stderr: int) -> bool:
    """Whether the console takes nothing more, after 30 s at most."""
    return any(not select.select([], [stderr], [], 0)[1] or pause() for _ in range(600))


def pause() -> bool:
    select.select([], [], [], 0.05)
    return False


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
    assert shown == ["one", "two", 3000 * "x"]
    assert sys.stderr is errors
    assert out.getvalue() == "to a file\n"
